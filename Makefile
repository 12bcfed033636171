# `make train` and `make test` work on a fresh clone with python3 >= 3.11 and nothing else.
PYTHON ?= python3
MINUTES ?= 10
VERSIONS ?= 3.12 3.13 lowest
RUNS ?= 200
# One more than there are cores, because tests of processes wait for most of their time. They begin at different places of the
# list of tests, and who has finished takes some of another's: so tests that wait run beside tests that compute.
TEST_PROCESSES ?= $(shell expr $$(nproc) + 1)
BIN := .venv/bin
PYTEST := $(BIN)/python -m pytest --numprocesses $(TEST_PROCESSES) --dist worksteal
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: train check test test-rest test-all lint type type-all pure unit unit-rest docs site dist bench bench-peers test-learning \
	packages test-cluster test-clients test-recipes test-model test-processors test-versions test-kill soak clean

train: .venv/installed  ## train CartPole-v1 on two worker processes until a greedy evaluation averages 475
	$(BIN)/millrace train CartPole-v1 --workers 2 --target-return 475 --eval-episodes 20 --eval-every 5000

check: .venv/installed-dev  ## ruff, the product's types, and the tests that start no process; one minute
	@$(MAKE) --no-print-directory --jobs 2 lint type pure

test: .venv/installed-dev  ## also one whole run for each fault, command and feature, and what is between; four minutes
	@$(MAKE) --no-print-directory --jobs 2 lint type unit

test-rest: .venv/installed-dev  ## what `make test` leaves out: variants, extras, every example of a property, the tests' types
	@$(MAKE) --no-print-directory --jobs 2 type-all unit-rest

test-all: .venv/installed-dev  ## both: all tests that need neither root nor more packages; twelve minutes
	@$(MAKE) --no-print-directory test
	@$(MAKE) --no-print-directory test-rest

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: .venv/installed-dev
	$(BIN)/mypy millrace

type-all: .venv/installed-dev
	$(BIN)/mypy

pure: .venv/installed-dev
	$(PYTEST) --layer check

unit: .venv/installed-dev
	$(PYTEST) --layer test

unit-rest: .venv/installed-dev
	$(PYTEST) --layer rest

test-learning: .venv/installed-dev  ## published scores and other facts of learning, three seeds each; half an hour
	$(BIN)/python -m pytest -m learning --timeout 3600 tests/learning

packages:  ## install Debian's packages for test-clients and test-cluster. Needs root
	apt-get -qq update
	DEBIAN_FRONTEND=noninteractive apt-get -qq install --no-install-recommends $$(grep -v '^#' tests/packages.txt) \
		$$(command -v npm > /dev/null || echo nodejs npm) > /dev/null

test-model: .venv/installed-dev  ## every interleaving of messages, faults and time in small runs, and mistakes made on purpose; five minutes on two cores
	$(BIN)/python -m pytest -m model -rP --numprocesses $(TEST_PROCESSES) tests/model

test-cluster: .venv/installed-ray  ## Docker, Prometheus, Slurm, Ray, MPI, Xvfb and Chromium, for real. Needs root and `make packages`
	$(BIN)/python -m pytest -m cluster -rs -o log_level=INFO --numprocesses $(TEST_PROCESSES) --dist loadfile tests/cluster

test-clients: .venv/installed-dev  ## the clients in C++ and other languages, built and run. Needs `make packages`
	$(BIN)/python -m pytest -m clients -rs --numprocesses $(TEST_PROCESSES) --dist worksteal tests/clients

test-recipes: .venv/installed-dev .venv-recipes/installed  ## the recipes for SUMO, FMUs, grid2op and others, with the real simulators (2 GB)
	$(BIN)/python -m pytest -m recipes tests/recipes

test-processors: .venv/installed-dev  ## the tests that compare floats, with the code that PyTorch and numpy run on other processors
	$(BIN)/python -m tests.processors

test-versions:  ## all tests on other Pythons, and with the lowest versions that pyproject.toml allows
	$(PYTHON) -m tests.versions $(VERSIONS)

test-kill: .venv/installed-dev  ## small runs, each killed at random times and resumed until it is done; half an hour
	$(BIN)/python -m tests.system.random_faults.killed_runs --runs $(RUNS)

soak: export TESTS_EXEC := 1
soak: .venv/installed-dev  ## faults for ten minutes, every two seconds one; then the faults that take too long for `make test`. Needs root
	$(BIN)/python -m tests.system.random_faults.soak --minutes $(MINUTES)
	$(BIN)/python -m pytest -m soak tests

docs: .venv/installed-dev  ## write what is made from the code: parts of protocol/README.md, millrace/keywords.py, three reference pages
	$(BIN)/python -m tests.protocol.test_wire_document
	$(BIN)/python -m tests.millrace.test_keywords
	$(BIN)/python -m website.pages

site: .venv/installed-docs  ## build the documentation in site/: warnings are errors, links are checked, every block of code runs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python -m pytest --numprocesses $$(nproc) -m 'docs or not docs' tests/docs tests/millrace/test_notebook.py

dist: .venv/installed-dev  ## build sdist and wheel in dist/, install each into a clean environment, and train from there
	$(BIN)/python -m tests.distributions

bench: .venv/installed-dev  ## all benchmarks, ten minutes: tables here, JSON and pictures in benchmarks/results
	$(BIN)/millrace bench

bench-peers: .venv/installed-dev  ## training beside seven other systems, each in an environment of its own (3 GB); forty minutes
	$(BIN)/python -m benchmarks.peers.install || true  # what cannot be installed is left out
	$(BIN)/millrace bench train --peers

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("millrace needs Python 3.11 or newer; set PYTHON=") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv .venv
	$(PIP_INSTALL) --editable .
	touch $@

.venv/installed-dev: .venv/installed
	$(PIP_INSTALL) --editable '.[dev]'
	touch $@

.venv/installed-ray: .venv/installed-dev
	$(PIP_INSTALL) --editable '.[ray]'
	touch $@

.venv/installed-docs: .venv/installed-dev
	$(PIP_INSTALL) --editable '.[docs]'
	touch $@

.venv-recipes/installed: pyproject.toml tests/recipes/requirements.txt tests/recipes/pinned.txt
	$(PYTHON) -m venv .venv-recipes
	.venv-recipes/bin/python -m pip install --quiet --requirement tests/recipes/requirements.txt --editable .
	$(PYTHON) -m venv .venv-recipes/pinned
	.venv-recipes/pinned/bin/python -m pip install --quiet --requirement tests/recipes/pinned.txt
	touch $@

clean:
	rm -rf .venv .venv-recipes site .versions .cluster benchmarks/peers/envs .mypy_cache .ruff_cache .pytest_cache .hypothesis
