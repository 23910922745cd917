# Each target sets up all that it needs, in .venv, from nothing but python3 (3.11 to 3.13) and the Python registry.
PYTHON ?= python3
VENV := .venv
ROVER := $(VENV)/bin/rover
LAB := $(VENV)/bin/python -m lab
READY := $(VENV)/.ready
NAME ?= mine

.PHONY: help demo run test lint lab arm faults pi-fast pi firmware flash notebooks clean

help:
	@echo "make demo                                   record, train, quantize, compare, benchmark and drive in the balloon world"
	@echo "make run CHECKPOINT=x.pth EPISODES=dir NAME=mine    the same five notebooks on your own policy"
	@echo "make test                                   lint, unit, parity, notebook tests and one whole run"
	@echo "make arm NAME=demo [PEERS=1]                count a run's instructions on an emulated Cortex-A76;"
	@echo "                                            NAME=full makes a policy of the real car's size, PEERS=1 adds other runtimes"
	@echo "make faults                                 what fails while driving, on the pins of an emulated Arduino: about 6 minutes"
	@echo "make pi-fast                                every playbook on an emulated Pi in a container, and what they promise,"
	@echo "                                            proven from within: an hour; root, on Debian 12"
	@echo "make pi                                     a whole emulated Pi: kernel, camera, INT8, USB serial, servo pulses, pulled"
	@echo "                                            cables: half an hour, the first time three quarters; root, on Debian 12"
	@echo "make firmware; make flash PORT=/dev/ttyUSB0  build the Arduino's firmware, and put it on the board"
	@echo "make lab                                    JupyterLab on the notebooks"
	@echo "make notebooks                              put the demo's outputs, and runs/full's count, into the committed notebooks"

# uv installs the CUDA build of torch, gigabytes that its wheel insists on, in a minute where pip takes several.
$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14) and f"Python 3.11 to 3.13 is needed, found {sys.version.split()[0]}: make PYTHON=python3.12")'
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet 'uv>=0.5'
	$(VENV)/bin/uv pip install --quiet --python $(VENV)/bin/python -e '.[workshop,dev]'
	@touch $@

demo: $(READY)
	$(ROVER) world record runs/demo/episodes
	$(ROVER) world train runs/demo/episodes runs/demo/best_model.pth
	$(ROVER) run runs/demo/best_model.pth runs/demo/episodes --name demo --worlds 40
	$(ROVER) world latency runs/demo

run: $(READY)
	@test -n '$(CHECKPOINT)' -a -n '$(EPISODES)' || { echo 'make run needs CHECKPOINT=best_model.pth EPISODES=folder [NAME=mine]' >&2; exit 2; }
	$(ROVER) run '$(CHECKPOINT)' '$(EPISODES)' --name '$(NAME)'

lint: $(READY)
	$(VENV)/bin/ruff check --quiet
	$(VENV)/bin/ruff format --quiet --check

# The demo is the tests' whole run; it is made once, and tests/test_demo.py holds it to the gates of params.yml.
test: lint demo
	$(VENV)/bin/pytest

# NAME=full needs no checkpoint: it makes one. quantize.json is the last that a run of it leaves.
arm: $(READY)
	@test '$(NAME)' != full -o -f runs/full/quantize.json || { echo $(LAB) full runs/full; $(LAB) full runs/full; }
	$(LAB) arm 'runs/$(NAME)' $(if $(PEERS),--peers) $(if $(filter full,$(NAME)),--details)

faults: $(READY)
	$(LAB) faults runs/faults.json

# The demo's artifacts are deployed.
pi-fast: $(READY)
	@test -f runs/demo/policy_mixed.pt || $(MAKE) demo
	$(LAB) pi fast runs/pi-fast.json

# The demo's artifact is deployed, and its recordings are what the camera sees.
pi: $(READY)
	@test -f runs/demo/policy_static.pt || $(MAKE) demo
	$(LAB) pi whole runs/pi.json

firmware:
	$(MAKE) -C firmware

flash:
	$(MAKE) -C firmware flash PORT='$(PORT)'

lab: $(READY)
	$(VENV)/bin/jupyter lab notebooks

notebooks: demo
	$(VENV)/bin/python -c "from rover_lib.workshop.run import NAMES, publish; publish('runs/demo', 'notebooks', (*NAMES, '07_drive'))"
	test ! -f runs/full/06_arm.ipynb || $(VENV)/bin/python -c "from rover_lib.workshop.run import publish; publish('runs/full', 'notebooks', ('06_arm',))"

clean:
	rm -rf $(VENV) runs
