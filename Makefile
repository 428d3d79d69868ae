# On a fresh clone with Python 3.11 and make only: `make study` runs the paper's study, `make test` checks it.
PYTHON ?= python3.11
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= passive
unexport PYTHONDONTWRITEBYTECODE # hundreds of processes would compile every module again

.NOTPARALLEL: # two goals may need the same environment
.PHONY: help install study test test-all lint docs clean

help:
	@echo "make study   install what running needs and run the paper's study (conf/experiment/paper.yaml)"
	@echo "make test    install the tools too, then formatter check, linters, type checker, tests"
	@echo "make test-all  the same with the long tests: commands of the docs, notebooks, page, hard studies"
	@echo "make docs    build the documentation site into site/, warnings are errors"
	@echo "make clean   remove the environment and every cache (results stay)"

# No module is compiled at installation: Python compiles what is imported, less than a third, and keeps it.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# The pip that Python brings takes twice as long to choose releases as the one of constraints.txt.
# torch goes first and alone: any looser request pulls gigabytes of GPU packages that a CPU does not need.
.venv/.torch: constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) pip
	$(PIP) torch
	@touch $@

.venv/.running: .venv/.torch pyproject.toml
	$(PIP) --editable '.[report,export]'
	@touch $@

# What checks and writes the project, and what runs it.
.venv/.installed: .venv/.torch pyproject.toml
	$(PIP) --editable '.[dev]'
	@touch .venv/.running $@

install: .venv/.installed

study: .venv/.running
	$(BIN)/ssm-study run experiment=paper

# One worker more than there are cores: many tests wait for processes that they start.
WORKERS = $$($(BIN)/python -c "import os; print(min(8, (os.cpu_count() or 1) + 1))")
TESTS = $(BIN)/pytest -n $(WORKERS) --dist worksteal

test: lint
	$(TESTS) -m "not long"

test-all: lint
	$(TESTS)

# At first, what the tests import is compiled meanwhile: once, not by each worker.
COLLECT = $(BIN)/pytest --collect-only -qq >/dev/null 2>&1; touch .venv/.collected

# On a busy machine its workers may answer too late, which it calls an internal error (status 2).
MYPY = { $(BIN)/mypy --num-workers auto || { [ $$? = 2 ] && $(BIN)/mypy; }; }

lint: .venv/.installed
	@{ [ .venv/.collected -nt .venv/.installed ] || { $(COLLECT); }; } & \
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/lint-imports && \
	$(MYPY); linted=$$?; wait; exit $$linted

docs: install
	$(BIN)/mkdocs build --strict

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis site build dist
