# Two commands on a fresh machine: `make demo` sets up what it needs and runs the main job; `make test` sets up, lints and tests.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test lint setup setup-test

setup:
	@PYTHON=$(PYTHON) sh tools/setup.sh demo

setup-test:
	@PYTHON=$(PYTHON) sh tools/setup.sh test

demo: setup
	$(BIN)/python tools/demo.py

lint: setup-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# a file of tests to each of two processes in the order of tests/conftest.py, one thread each: two cores are then busy, and
# no threads wait for a core
test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
