# Two commands on a fresh machine with Python 3.11 or newer:
#   make demo    creates .venv, installs, runs the tour
#   make test    the same, then all checks and tests
#
# PYTHON=python3.12      another interpreter
# VENV=some/folder       another environment
# PIP_ARGS="..."         more arguments for pip, for example another package index for a CPU build of torch

PYTHON ?= python3
VENV ?= .venv
PIP_ARGS ?=
JOBS ?= 2

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
SOURCES := pyproject.toml constraints.txt

.PHONY: demo test check unit warmup bench clean

demo: $(VENV)/.installed-demo
	$(BIN)/clothgym demo

test: check unit

check: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# kernels are compiled once, before the workers start
unit: warmup
	$(BIN)/pytest -n $(JOBS) --dist loadfile

warmup: $(VENV)/.installed-test
	$(BIN)/clothgym warmup

bench: $(VENV)/.installed-test
	$(BIN)/clothgym bench all --quick

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-demo: $(SOURCES) | $(BIN)/python
	$(PIP) install --quiet $(PIP_ARGS) -c constraints.txt -e ".[rerun,plot]"
	touch $@

$(VENV)/.installed-test: $(SOURCES) $(VENV)/.installed-demo
	$(PIP) install --quiet $(PIP_ARGS) -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache
