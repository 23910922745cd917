# Each target sets up all that it needs, in .venv, from nothing but python3 (3.11 to 3.13) and the Python registry.
PYTHON ?= python3
VENV := .venv
ROVER := $(VENV)/bin/rover
READY := $(VENV)/.ready
NAME ?= mine

.PHONY: help demo run test lint lab arm notebooks clean

help:
	@echo "make demo                                   record, train, quantize, compare and benchmark in the balloon world"
	@echo "make run CHECKPOINT=x.pth EPISODES=dir NAME=mine    the same five notebooks on your own policy"
	@echo "make test                                   lint, unit, parity, notebook tests and one whole run"
	@echo "make arm NAME=demo                          count a run's instructions on an emulated Cortex-A76"
	@echo "make lab                                    JupyterLab on the notebooks"
	@echo "make notebooks                              put the demo's outputs into the committed notebooks"

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

run: $(READY)
	@test -n '$(CHECKPOINT)' -a -n '$(EPISODES)' || { echo 'make run needs CHECKPOINT=best_model.pth EPISODES=folder [NAME=mine]' >&2; exit 2; }
	$(ROVER) run '$(CHECKPOINT)' '$(EPISODES)' --name '$(NAME)'

lint: $(READY)
	$(VENV)/bin/ruff check --quiet
	$(VENV)/bin/ruff format --quiet --check

# The demo is the tests' whole run; it is made once, and tests/test_demo.py holds it to the gates of params.yml.
test: lint demo
	$(VENV)/bin/pytest

arm: $(READY)
	$(ROVER) arm 'runs/$(NAME)'

lab: $(READY)
	$(VENV)/bin/jupyter lab notebooks

notebooks: demo
	$(VENV)/bin/python -c "from rover_lib.workshop.run import publish; publish('runs/demo', 'notebooks')"

clean:
	rm -rf $(VENV) runs
