# `make help` lists the targets. `make PYTHON=python3.12 install` chooses the interpreter, `make test PYTEST_ARGS="-k name"`
# the tests.
PYTHON ?= $(shell python3.11 -c "" 2>/dev/null && echo python3.11 || echo python3)
PYTEST_ARGS ?=
# Versions to install; empty for the newest that setup.cfg allows.
CONSTRAINTS ?= constraints.txt

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP_CONSTRAINTS := $(addprefix -c ,$(CONSTRAINTS))
LINT_PATHS := sb3_uav tests benchmarks examples scripts docs
# Some are about results, not speed: they take arguments and an hour, or have a target of their own.
NEED_ARGUMENTS := $(addprefix benchmarks/,ablation.py better_than_the_paper.py learned_start.py router_gap.py soak.py)
BENCHMARKS := $(filter-out benchmarks/_% $(NEED_ARGUMENTS),$(sort $(wildcard benchmarks/*.py)))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: install demo docs notebooks test test-fast lint format check-codestyle type commit-checks bench soak clean help

install: $(INSTALLED)  ## Create .venv and install the package, its extras and the development tools

# torch comes first and alone, so that PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu can choose the small build
# without CUDA, and a build that is installed already is kept.
$(INSTALLED): setup.cfg pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP_CONSTRAINTS) torch
	$(BIN)/python -m pip install $(PIP_CONSTRAINTS) -e ".[all,dev]"
	touch $@

demo: $(INSTALLED)  ## Train a small scenario, evaluate it against heuristics and draw it, into demo/ (at most 4 minutes)
	$(BIN)/sb3-uav demo --out demo

docs: $(INSTALLED)  ## Build the documentation site into docs/_build/html; any warning is an error
	$(BIN)/python -m sphinx -b html -W --keep-going -n docs docs/_build/html

notebooks: $(INSTALLED)  ## Run the notebooks of the docs and store their outputs
	OMP_NUM_THREADS=1 $(BIN)/python scripts/run_notebooks.py

# One process per core, and one thread in each: threads that wait for a busy core cost more than they bring.
test: $(INSTALLED)  ## Run the whole test suite
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto $(PYTEST_ARGS)

test-fast: $(INSTALLED)  ## Run the tests without the slow ones
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m "not slow" $(PYTEST_ARGS)

lint: $(INSTALLED)  ## Look for mistakes with ruff
	$(BIN)/ruff check $(LINT_PATHS)

format: $(INSTALLED)  ## Sort the imports and format the code
	$(BIN)/ruff check --select I --fix $(LINT_PATHS)
	$(BIN)/ruff format $(LINT_PATHS)

check-codestyle: $(INSTALLED)  ## Fail if `make format` would change anything
	$(BIN)/ruff check --select I $(LINT_PATHS)
	$(BIN)/ruff format --check $(LINT_PATHS)

type: $(INSTALLED)  ## Check the types with mypy
	$(BIN)/mypy $(LINT_PATHS)

commit-checks: format lint type  ## What to run before a commit

bench: $(INSTALLED)  ## Run every benchmark
	@set -e; for script in $(BENCHMARKS); do echo "== $$script"; $(BIN)/python $$script; done

soak: $(INSTALLED)  ## Kill trainings and evaluations 200 times at random, and compare what comes out with unbroken runs
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/soak.py --kills 200 --seed 1

clean:  ## Remove caches, builds and the demo's files (not .venv, not logs)
	rm -rf build dist demo *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find $(LINT_PATHS) -name __pycache__ -type d -prune -exec rm -rf {} +

help:  ## Show this list
	@awk -F ':.*  ## ' '/^[a-z-]+:.*  ## / {printf "  %-16s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
