# Two commands set everything up on a fresh machine with python3, pip, make and git:
#   make demo    install into .venv and run the main job on a simulated site
#   make test    install into .venv, check style, types, imports, and run every test
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
.DEFAULT_GOAL := help

.PHONY: help demo test check lock schemas docs clean

help:
	@sed -n 's/^#   //p' Makefile

.venv/installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(PIP) install --quiet --require-hashes -r requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

.venv/installed-dev: .venv/installed requirements-dev.lock
	$(PIP) install --quiet --require-hashes -r requirements-dev.lock
	@touch $@

demo: .venv/installed
	$(BIN)/tcpipe demo tcpipe-demo

check: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: check
	$(BIN)/pytest -n 2 --dist loadfile

# The locks: hashes, no registry address. Needs uv; run it when pyproject.toml's dependencies change.
UV_LOCK := uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate --no-header --quiet
lock:
	$(UV_LOCK) --extra build --output-file requirements.lock
	$(UV_LOCK) --extra build --extra dev --constraint requirements.lock --output-file requirements-dev.lock

schemas: .venv/installed
	$(BIN)/tcpipe schemas schemas

docs: .venv/installed
	$(BIN)/python docs/generate.py

clean:
	rm -rf .venv tcpipe-demo
