# Two commands set everything up on a fresh machine with python3, pip, make and git:
#   make demo    install into .venv and run the main job on a simulated site
#   make test    install into .venv, check style, types, imports, and run every test
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
.DEFAULT_GOAL := help

.PHONY: help demo test test-benchmarks test-operations test-object-storage test-dagster test-pages test-mutants check check-and-train kernels compare-peers lock docs pictures release clean

help:
	@sed -n 's/^#   //p' Makefile

# Where the environment forbids to keep bytecode, each process of the tests would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/installed: requirements.lock pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --require-hashes -r requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

# This lock holds all of the other.
.venv/installed-dev: requirements-dev.lock pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --require-hashes -r requirements-dev.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch .venv/installed $@

# PyTorch is pinned by version alone, since its CPU and CUDA builds differ in hash; `make test TORCH=` leaves out what needs it.
# Most of its modules are never imported: bytecode is made as they are.
TORCH ?= torch==2.13.0
.venv/installed-train: .venv/installed-dev requirements-train.lock
	$(PIP) install --quiet --no-compile --require-hashes -r requirements-train.lock
	$(PIP) install --quiet --no-compile $(TORCH)
	@touch $@

demo: .venv/installed
	$(BIN)/tcpipe demo tcpipe-demo

check: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# In random order; the seed that it prints repeats it: make test PYTEST="-n 2 --randomly-seed=N".
PYTEST ?= -n 2
test: .venv/installed-dev
	$(MAKE) --jobs 2 kernels check-and-train
	$(BIN)/pytest --dist loadfile --no-loadscope-reorder $(PYTEST)

check-and-train: check
	$(if $(TORCH),$(MAKE) .venv/installed-train)

# Each program of benchmarks/ once, at its smallest size, and the tests of the campaign and the honesty gate; some minutes on two cores.
test-benchmarks: .venv/installed-dev
	$(BIN)/pytest benchmarks/test_*.py $(PYTEST)

# Kills and interruptions at every request of calls on one store; about an hour on two cores.
test-operations: .venv/installed-dev
	TCPIPE_TEST_OPERATIONS=1 $(BIN)/pytest -rs tests/unit/pipeline/test_store_attacks.py $(PYTEST)

# Stores in a real object store: OBJECT_STORAGE is a program that starts and stops one below a directory, which `start` fills with `env`.
OBJECT_STORAGE ?= ../shared/tools/object-storage
test-object-storage: .venv/installed-dev
	TCPIPE_TEST_OBJECT_STORAGE=$(abspath $(OBJECT_STORAGE)) $(BIN)/pytest -rs -k gateway tests/unit/test_store.py tests/unit/formats/test_place.py tests/unit/pipeline/test_array_tasks.py

# Compiled while one core checks and installs: each worker of the tests would compile them for itself.
kernels: .venv/installed-dev
	@rm -rf .venv/tiny
	$(BIN)/python tests/tiny_pipeline.py .venv/tiny
	@rm -rf .venv/tiny

# The definitions for Dagster, executed (docs/how-to/run-unattended.md); its pins want an environment of their own.
.venv-dagster/installed: pyproject.toml
	$(PYTHON) -m venv .venv-dagster
	.venv-dagster/bin/python -m pip --disable-pip-version-check install --quiet --no-compile dagster==1.13.27 hypothesis pytest pytest-randomly --editable '.[tables]'
	@touch $@

test-dagster: .venv-dagster/installed
	.venv-dagster/bin/python -m pytest tests/schedulers --override-ini filterwarnings=default

# Pages opened, clicked and read in Debian's Chromium; playwright wants an environment of its own.
.venv-pages/installed: pyproject.toml
	$(PYTHON) -m venv .venv-pages
	.venv-pages/bin/python -m pip --disable-pip-version-check install --quiet --no-compile playwright axe-core-python hypothesis pytest pytest-randomly --editable .
	@touch $@

test-pages: .venv-pages/installed
	.venv-pages/bin/python -m pytest tests/pages

# The documentation's pictures, from the demo.
pictures: .venv-pages/installed
	.venv-pages/bin/python docs/pictures.py

# Changes of the rooms of numbers, one at a time: does a test notice? docs/internals/tests.md; an hour and more on one core.
# MUTANTS="--rooms motion path --draw 0" tries less.
MUTANTS ?=
.venv-mutants/installed: requirements-dev.lock pyproject.toml
	$(PYTHON) -m venv .venv-mutants
	.venv-mutants/bin/python -m pip --disable-pip-version-check install --quiet --require-hashes -r requirements-dev.lock
	.venv-mutants/bin/python -m pip --disable-pip-version-check install --quiet cosmic-ray==8.7.0
	.venv-mutants/bin/python -m pip --disable-pip-version-check install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

test-mutants: .venv-mutants/installed
	.venv-mutants/bin/python tests/mutants.py $(MUTANTS)

# tcpipe beside pyins on the same simulated drives (PEERS="--seeds 1" is shorter), whose pandas wants an environment of its own.
PEERS ?=
.venv-peers/installed: pyproject.toml
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip --disable-pip-version-check install --quiet --no-compile python-ins==1.0.1 --editable .
	@touch $@

compare-peers: .venv-peers/installed
	.venv-peers/bin/python benchmarks/peers.py $(PEERS)

# The locks: hashes, no registry address. Needs uv; run it when pyproject.toml's dependencies change.
# The one for training holds what PyTorch needs beside itself.
UV_LOCK := uv pip compile --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate --no-header --quiet
lock:
	$(UV_LOCK) pyproject.toml --extra build --output-file requirements.lock
	$(UV_LOCK) pyproject.toml --extra build --extra dev --extra tables --extra cluster --constraint requirements.lock --output-file requirements-dev.lock
	printf '%s\n' filelock fsspec jinja2 networkx setuptools sympy typing-extensions | \
	  $(UV_LOCK) - --constraint requirements-dev.lock --output-file requirements-train.lock

# The reference from the code, then the site, whose tools have an environment of their own.
.venv-docs/installed: Makefile
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip --disable-pip-version-check install --quiet mkdocs==1.6.1 mkdocs-material==9.8.1
	@touch $@

docs: .venv/installed .venv-docs/installed
	$(BIN)/python docs/generate.py
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --strict --quiet

# Wheel and sdist into dist/, proved as a newcomer would: the wheel alone in a fresh environment, elsewhere, runs the demo.
release: .venv/installed
	rm -rf dist build/release
	$(BIN)/python -m hatchling build -d dist
	$(PYTHON) -m venv build/release/env
	build/release/env/bin/python -m pip --disable-pip-version-check install --quiet --require-hashes -r requirements.lock
	build/release/env/bin/python -m pip --disable-pip-version-check install --quiet --no-deps dist/*.whl
	cd build/release && env/bin/tcpipe demo --quiet && env/bin/tcpipe verify tcpipe-demo/dataset
	@ls dist

clean:
	rm -rf .venv .venv-dagster .venv-docs .venv-pages .venv-mutants .venv-peers build dist tcpipe-demo
