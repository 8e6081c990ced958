# make demo    install what the main job needs and run it on a small synthetic dataset with recorded depth
# make demo-no-depth    the same with colour alone, as a webcam records it
# make test    install everything and run the tests except those marked slow; make test-all runs all of them
# make lint    formatting, lint and types
unexport PYTHONDONTWRITEBYTECODE  # torch and lerobot compiled anew at every start would cost more than the tests
.PHONY: setup demo demo-no-depth test test-all lint clean

PYTHON ?= $(shell command -v python || command -v python3)
# one that runs: a version manager's shim may belong to another Python
UV := $(shell uv --version >/dev/null 2>&1 && command -v uv || echo .tools/bin/uv)
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := cuda,viz,priors,onnx,sfm,robots,cluster,evaluate,dev
TESTS ?= tests

setup: $(VENV)/.ready

$(VENV)/.core: pyproject.toml constraints.txt
	@command -v $(UV) >/dev/null || $(PYTHON) -m pip install --quiet --target .tools uv
	@test -x $(BIN)/python || $(UV) venv --quiet --python 3.12 $(VENV)
	$(UV) pip install --quiet --python $(BIN)/python --constraint constraints.txt --editable .
	@touch $@

$(VENV)/.ready: $(VENV)/.core
	$(UV) pip install --quiet --compile-bytecode --python $(BIN)/python --constraint constraints.txt --editable '.[$(EXTRAS)]'
	@touch $@

demo: $(VENV)/.core
	$(BIN)/python examples/01_demo.py

demo-no-depth: $(VENV)/.core
	$(BIN)/python examples/01_demo.py --no_depth

test: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow" $(TESTS)

test-all: setup
	$(BIN)/python -m pytest -n 2 --dist loadfile $(TESTS)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) .tools demo_out example_out
