# `make demo` and `make test` need only Python 3.11+ and make; everything is installed into .venv.
PYTHON ?= python3
WORKERS ?= 2
VENV := .venv
RUN := $(VENV)/bin/python
INSTALL := $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow bench lint format clean

help:
	@echo "make demo       install, train the pendulum, write the replay (runs/)"
	@echo "make test       install, lint, type check, run the tests"
	@echo "make test-slow  install, run the full sweeps"
	@echo "make bench      install, measure speed against error (tests/benchmarks/results/, README)"
	@echo "make lint       install, ruff, pyright and import contracts only"
	@echo "make format     install, format the sources"
	@echo "Another interpreter: make demo PYTHON=python3.12"

demo: $(VENV)/train.stamp
	$(RUN) -m training.demo

test: lint
	$(RUN) -m pytest -n $(WORKERS)

test-slow: $(VENV)/test.stamp
	$(RUN) -m pytest -n $(WORKERS) -m slow

bench: $(VENV)/bench.stamp
	$(RUN) -m tests.benchmarks
	$(RUN) -m tests.benchmarks.work_precision
	$(RUN) -m tests.status

lint: $(VENV)/test.stamp
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright --pythonpath $(RUN)
	$(VENV)/bin/lint-imports

format: $(VENV)/test.stamp
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

clean:
	rm -rf $(VENV)

# A stamp is written only after a complete step, so an interrupted installation is repeated.
$(VENV)/created.stamp:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" 2>/dev/null || \
	  { echo "error: Python 3.11 or newer is needed; '$(PYTHON)' is missing or older. Name another: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/train.stamp: pyproject.toml | $(VENV)/created.stamp
	$(INSTALL) -e ".[train]"
	@touch $@

$(VENV)/test.stamp: pyproject.toml | $(VENV)/created.stamp
	$(INSTALL) -e ".[train,test]"
	@touch $@ $(VENV)/train.stamp

$(VENV)/bench.stamp: pyproject.toml | $(VENV)/created.stamp
	$(INSTALL) -e ".[train,bench]"
	@touch $@ $(VENV)/train.stamp
