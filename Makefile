# Each target sets up all that it needs, in .venv, from nothing but python3 (3.11 to 3.13) and the Python registry.
PYTHON ?= python3
VENV := .venv
ROVER := $(VENV)/bin/rover
LAB := $(VENV)/bin/python -m lab
PACKAGES := rover_lib rover_exchange rover_learn balloon_world lab research lerobot_robot_rover
READY := $(VENV)/.ready
LOOK := runs/look
# Each process runs whole test files or notebooks, and one waits while others compute. More than four processes would
# cost more memory than they save time.
# They go in the order of the folders: ansible and lab have the longest files, which would run alone if they came last.
PROCESSES ?= $(shell echo $$(($$(nproc) + 1)))
PYTEST := $(VENV)/bin/pytest --numprocesses $(PROCESSES) --maxprocesses 4 --dist loadfile --no-loadscope-reorder
NAME ?= mine
# Of the balloon worlds to look at: easy or hard. The page can change it.
LEVEL ?= easy
DEMO := runs/demo/.made
SOURCES := $(sort $(shell find rover_lib rover_learn balloon_world notebooks -name '*.py' -o -name '*.ipynb' -o -name '*.html')) $(wildcard params.yml car.yml)
# A container may have no user but root. Root may load artifacts here, as they were made here; see onboard/policy/confine.py.
export ROVER_AS_ROOT := 1
# Some container images forbid Python to store its bytecode; then every process compiles torch again, which takes 2 s.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help look demo demo-more watch run notebooks-open docs test test-fast lint check-release mutants count notebooks

help:
	@echo "make look [LEVEL=hard]                      in two minutes: a policy drives, in your browser"
	@echo "make demo                                   in the balloon world: record, train, quantize, drive, and judge"
	@echo "make watch                                  the demo's policy drives through that world, live in the browser"
	@echo "make run CHECKPOINT=x.pth EPISODES=dir NAME=mine    the same five notebooks on your own policy"
	@echo "make notebooks-open NAME=mine [AS=try1]     JupyterLab on a copy of a run's notebooks, with its outputs; the run stays"
	@echo "make demo-more                              late plans, and a smaller policy that the demo's teaches: half an hour"
	@echo "make docs                                   these pages and the notebooks as a site: runs/site/index.html"
	@echo
	@echo "For who changes something; CONTRIBUTING.md says what each proves and how long it takes:"
	@echo "make test-fast, make lint                   what two minutes can prove"
	@echo "make test                                   lint, tests and notebooks, on the demo's run"
	@echo "make check-release                          what takes two hours and a quiet machine"
	@echo "make mutants                                break lines of the safety path: tests and random drives must notice"
	@echo "make count NAME=demo                        count a run's instructions on an emulated Cortex-A76; NAME=full makes"
	@echo "                                            a policy of the real car's size, LEARNED=1 one that has learned to"
	@echo "                                            drive (an hour or more)"
	@echo "make notebooks                              put the demo's outputs, and runs/full's count and students, into the"
	@echo "                                            notebooks, the JSON behind them into results/, pictures, the tables"

# ensurepip is called on its own because venv hides why it failed. If it fails (a full disk, no bundled wheels), the
# pip of $(PYTHON) installs pip into the environment. An unfinished environment without pip gets one this way too.
# The wheel of torch requires gigabytes of CUDA packages: uv installs them in a minute, pip in several.
$(READY): pyproject.toml lerobot_robot_rover/pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14) and f"Python 3.11 to 3.13 is needed, found {sys.version.split()[0]}: make PYTHON=python3.12")'
	test -x $(VENV)/bin/python || $(PYTHON) -m venv --without-pip $(VENV)
	$(VENV)/bin/python -m pip --version > /dev/null 2>&1 || $(VENV)/bin/python -m ensurepip --upgrade --default-pip > /dev/null || $(PYTHON) -m pip --python $(VENV)/bin/python install --quiet pip
	$(VENV)/bin/python -m pip install --quiet 'uv>=0.8'
	$(VENV)/bin/uv pip install --quiet --python $(VENV)/bin/python --group dev --group docs -e '.[workshop,look]' -e ./lerobot_robot_rover
	@touch $@

# Without torch, in an environment of its own.
look:
	test -x $(LOOK)/bin/rover || { $(PYTHON) -m venv $(LOOK) && $(LOOK)/bin/pip install --quiet '.[look]'; }
	$(LOOK)/bin/rover demo --level $(LEVEL)

# As many steps as two minutes have, and no weights from the internet: the same policy on each machine of a kind.
DEMO_TRAINING = --steps 640 --backbone none

# Recordings that another version of the world made are recorded again. It ends with the verdict, and what to do next stands last on the screen.
demo: $(READY)
	@rm -f $(DEMO)
	$(ROVER) world record runs/demo/episodes
	$(ROVER) train runs/demo/episodes runs/demo/best_model.pth $(DEMO_TRAINING)
	$(ROVER) run runs/demo/best_model.pth runs/demo/episodes --name demo --worlds 40
	@sha256sum $(SOURCES) > $(DEMO)
	@echo
	@echo 'its notebooks, in JupyterLab:   make notebooks-open NAME=demo'
	@echo 'late plans, a smaller policy:   make demo-more'
	@echo 'see it drive in your browser:   make watch'

demo-more: $(DEMO)
	$(ROVER) run --only 07 --name demo
	@rm -rf runs/demo-small
	$(ROVER) distill runs/demo/best_model.pth runs/demo/episodes --name demo-small --size 96x54 --feedforward 256
	$(ROVER) run runs/demo-small/best_model.pth runs/demo/episodes --name demo-small -p modes '[static]'
	$(ROVER) world students runs/demo runs/demo-small --worlds 40
	$(ROVER) report runs/demo

watch: $(READY)
	@test -f runs/demo/policy_static.pt || $(MAKE) demo
	$(ROVER) view runs/demo/policy_static.pt

run: $(READY)
	@test -n '$(CHECKPOINT)' -a -n '$(EPISODES)' || { echo 'make run needs CHECKPOINT=best_model.pth EPISODES=folder [NAME=mine]' >&2; exit 2; }
	$(ROVER) run '$(CHECKPOINT)' '$(EPISODES)' --name '$(NAME)'

lint: $(READY)
	$(VENV)/bin/ruff check --quiet
	$(VENV)/bin/ruff format --quiet --check
	$(VENV)/bin/mypy
	$(VENV)/bin/codespell *.md *.yml *.toml ansible docs firmware notebooks tests $(PACKAGES)
	PATH='$(CURDIR)/$(VENV)/bin':"$$PATH" ANSIBLE_HOME='$(CURDIR)/runs/ansible' ansible-lint --offline --profile=production --strict -q ansible

# The tests use the demo as their example of a whole run, and tests/test_demo.py holds it to the gates of params.yml.
# The demo takes minutes, and most changes are to tests; so it is made again only if one of its sources says something
# else than before, and not for one that was only opened and saved.
$(DEMO): $(READY) $(SOURCES)
	@sha256sum $(SOURCES) | cmp --silent - $(DEMO) && touch $(DEMO) || $(MAKE) demo

# Some tests call make, for which it does not matter how this one was called.
test: lint $(DEMO)
	MAKEFLAGS= $(PYTEST)

# No notebook is among these tests, so they do without nbval, whose import takes three seconds in each process.
# They hardly wait for anything, so that a process more than there are cores would only import torch once more.
test-fast: $(READY)
	$(PYTEST) --numprocesses $$(nproc) -p no:nbval --override-ini 'addopts=-q -rs --strict-markers' -m 'not slow and not emulated and not release and not research' tests

# Tests in real time and of whole fleets. Run them on a quiet machine before each release.
check-release: lint $(DEMO)
	$(MAKE) demo-more
	$(VENV)/bin/pytest -m 'release or research' tests
	$(VENV)/bin/pytest notebooks
	$(LAB) faults runs/faults.json
	for car in crawler inverted; do $(LAB) faults runs/faults-$$car.json --car lab/cars/$$car.yml || exit; done
	$(LAB) random runs/random.json
	$(MAKE) mutants
	$(LAB) --install pi runs/pi.json

# NAME=full needs no checkpoint: it makes one. After 24 steps a policy does not drive, so that its run fails its gates.
count: $(READY)
	@test '$(NAME)' != full -o -f runs/full/policy_static.onnx.zip || { \
	$(ROVER) world record runs/full/episodes --count $(if $(LEARNED),80,16) && \
	$(ROVER) train runs/full/episodes runs/full/best_model.pth --size full --backbone none $(if $(LEARNED),,--steps 24) && \
	{ $(ROVER) run runs/full/best_model.pth runs/full/episodes --name full --samples 64 -p modes '[static]'; $(ROVER) export runs/full --onnx; }; }
	$(LAB) arm 'runs/$(NAME)'

mutants: $(READY)
	$(LAB) mutants runs/mutants.json --drives

# Without NAME it opens the repository's notebooks.
notebooks-open: $(READY)
	$(if $(filter file,$(origin NAME)),JUPYTER_CONFIG_PATH='$(CURDIR)/rover_lib/workshop/jupyter' $(VENV)/bin/python -m jupyterlab $(if $(filter 0,$(shell id -u)),--allow-root) notebooks,$(ROVER) notebooks 'runs/$(NAME)' $(if $(filter default,$(origin AS)),,--as '$(AS)'))

notebooks: demo demo-more
	$(VENV)/bin/python -m lab.repository.publish
	$(VENV)/bin/python -m lab.repository.film
	$(VENV)/bin/python -m lab.repository.page_tables

# The pages, and all that they link to. A link to anything else fails the build.
PAGES = *.md params.yml lab/params.yml docs/* ansible/README.md ansible/roles/rover/meta/argument_specs.yml ansible/roles/rover/README.md firmware/README.md lab/README.md notebooks/*.ipynb pictures/* results/*/*.json

docs: $(READY)
	rm -rf runs/pages runs/site
	mkdir -p runs/pages
	cp --parents $(PAGES) runs/pages
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build
	@echo 'open runs/site/index.html'
