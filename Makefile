# On a fresh clone with Python 3.11 and make only: `make study` runs the paper's study, `make test` checks it.
PYTHON ?= python3.11
BIN := .venv/bin
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= passive
unexport PYTHONDONTWRITEBYTECODE # hundreds of processes would compile every module again

.PHONY: help install study test test-all lint docs clean

help:
	@echo "make study   install what running needs and run the paper's study (conf/experiment/paper.yaml)"
	@echo "make test    install the tools too, then formatter check, linters, type checker, tests"
	@echo "make test-all  the same with the long tests: commands of the docs, notebooks, page, hard studies"
	@echo "make docs    build the documentation site into site/, warnings are errors"
	@echo "make clean   remove the environment and every cache (results stay)"

# pip compiles each module on one core, which takes longer than to unpack it: here all cores do.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt
COMPILE := $(BIN)/python -m compileall -qq -j 0 .venv/lib || true # templates among them are no Python

# torch goes first and alone: any looser request pulls gigabytes of GPU packages that a CPU does not need.
.venv/.running: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) torch
	$(PIP) --editable '.[report,export]'
	@touch $@

.venv/.compiled: .venv/.running
	@$(COMPILE)
	@touch $@

# What checks and writes the project, on top of what runs it.
.venv/.installed: .venv/.running
	$(PIP) --editable '.[dev]'
	@touch $@

install: .venv/.installed
	@$(COMPILE)

study: .venv/.compiled
	$(BIN)/ssm-study run experiment=paper

# The linters need no library that is to be compiled: meanwhile that is done.
# One worker more than there are cores: many tests wait for processes that they start.
WORKERS = $$($(BIN)/python -c "import os; print(min(8, (os.cpu_count() or 1) + 1))")
TESTS = $(BIN)/pytest -n $(WORKERS) --dist worksteal

test: lint
	$(TESTS) -m "not long"

test-all: lint
	$(TESTS)

lint: .venv/.installed
	@$(COMPILE) & $(BIN)/ruff format --check . && $(BIN)/ruff check . && \
	$(BIN)/lint-imports && $(BIN)/mypy --num-workers auto; linted=$$?; wait; exit $$linted

docs: install
	$(BIN)/mkdocs build --strict

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .hypothesis site build dist
