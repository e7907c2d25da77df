# Needs Python 3.11 or newer and make; everything else goes into a virtual environment of its own.

VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
RUNTIME := $(VENV)/.runtime-installed
TOOLS := $(VENV)/.tools-installed
FLOWER := $(VENV)/.flower-installed
RAY := $(VENV)/.ray-installed
NOTEBOOK := $(VENV)/.notebook-installed
DIST := $(VENV)/.dist-installed
SITE := $(VENV)/.site-installed
# Small networks gain nothing from threads, and threads of several libraries get into each other's way.
export OMP_NUM_THREADS ?= 1
# Workers of the test suite must find the tests in the same order, in which sets may have a say.
export PYTHONHASHSEED ?= 0
# A worker of the test suite takes about a gigabyte; make test WORKERS= runs all tests in one process.
WORKERS ?= --numprocesses auto --maxprocesses 4 --dist worksteal

.PHONY: help install train demo test test-slow test-flower test-flower-slow test-ray test-dist lint type docs notebook dist format clean

help:
	@echo "make train      install, then FedGuide on HopperHard, end to end"
	@echo "make demo       Bandit2D in a minute: FedAvg beside FedGuide, with a picture in runs/demo"
	@echo "make test       the test suite"
	@echo "make test-slow  the long tests as well"
	@echo "make test-flower test-flower-slow  deployments over Flower, with real processes; installs Flower"
	@echo "make test-ray   training and benchmarks on two Ray nodes; installs Ray"
	@echo "make test-dist  the wheel in a fresh environment outside this folder, the source distribution's files"
	@echo "make lint type  ruff, mypy"
	@echo "make docs       these pages as a site, build/docs/index.html; warnings are errors; installs Sphinx"
	@echo "make notebook   execute docs/notebooks again, in place, some minutes; installs a Jupyter kernel"
	@echo "make dist       source distribution and wheel in dist/, checked by twine; uploads nothing"
	@echo "make format     rewrite the code with ruff"
	@echo "make clean      remove caches and builds; runs, logs and the environment stay"

train: $(RUNTIME)
	$(BIN)/python train.py --algo fedguide --env HopperHard --progress $(ARGS)

demo: $(RUNTIME)
	$(BIN)/python -m sb3_fedguide demo --progress $(ARGS)

test: $(TOOLS)
	$(BIN)/python -m pytest $(WORKERS) $(ARGS)

test-slow: $(TOOLS) $(NOTEBOOK)
	FUZZ=1 $(BIN)/python -m pytest -m "not ray and not flower and not flower_slow and not dist" $(ARGS)

test-flower: $(TOOLS) $(FLOWER)
	$(BIN)/python -m pytest -m flower $(ARGS)

test-flower-slow: $(TOOLS) $(FLOWER)
	$(BIN)/python -m pytest -m flower_slow $(ARGS)

test-ray: $(TOOLS) $(RAY)
	$(BIN)/python -m pytest -m ray $(ARGS)

dist: $(DIST)
	rm -rf build/lib build/bdist.* dist
	$(BIN)/python -m build --quiet
	$(BIN)/python -m twine check --strict dist/*

test-dist: $(TOOLS) dist
	$(BIN)/python -m pytest -m dist $(ARGS)

lint: $(TOOLS)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .

type: $(TOOLS)
	$(BIN)/python -m mypy

docs: $(SITE)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs $(ARGS)
	@echo "build/docs/index.html"

notebook: $(NOTEBOOK)
	$(BIN)/jupyter-execute --inplace docs/notebooks/*.ipynb

format: $(TOOLS)
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

install: $(RUNTIME)

$(BIN)/python:
	@for candidate in $(PYTHON) python3.11 python3.12 python3.13 python3; do \
		if "$$candidate" -c 'import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then \
			echo "creating $(VENV) with $$candidate"; \
			exec "$$candidate" -m venv "$(VENV)"; \
		fi; \
	done; \
	echo "No Python 3.11 or newer with its venv module was found (on Debian and Ubuntu: python3.11 and python3.11-venv)." >&2; \
	echo "If it has another name, say so: make PYTHON=/path/to/python ..." >&2; \
	exit 1

# torch first: what follows finds its requirement met, by whichever build of it is wanted here
$(RUNTIME): setup.cfg pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) install --quiet --constraint constraints.txt torch
	$(PIP) install --quiet --constraint constraints.txt --editable '.[metaworld]'
	@touch $@

$(TOOLS): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@

$(RAY): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[ray]'
	@touch $@

$(NOTEBOOK): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[notebook]'
	@touch $@

$(DIST): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[dist]'
	@touch $@

$(SITE): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[docs]'
	@touch $@

$(FLOWER): $(RUNTIME)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[flower]'
	@touch $@

clean:
	rm -rf build dist docs/families docs/notebooks/*.md docs/notebooks/*.png *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
