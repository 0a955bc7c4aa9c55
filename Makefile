# Two commands do everything on a machine that has Python 3.11 or newer and pip:
#   make demo   the main job      make test   the tests
# PYTHON=python3.12 chooses another Python, VENV=dir another place for the virtual environment.

VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13; do \
  "$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)
BIN = $(VENV)/bin
INSTALLED = $(VENV)/.installed

.PHONY: demo test test-fast test-long lint bench gpu gpu-wheels accuracy logs docs clean help

help:
	@echo "make demo      set up and run the main job; the page is out/demo/index.html"
	@echo "make test      set up and run the tests"
	@echo "make test-fast the tests that need little compiling, for while you edit"
	@echo "make test-long the few tests that take minutes each"
	@echo "make bench     measure speed beside crazyflow, write docs/performance.md"
	@echo "make gpu       measure speed on a GPU, write docs/performance-gpu.md"
	@echo "make gpu-wheels  fetch into wheels/ what a GPU machine without network may lack (Python 3.12)"
	@echo "make accuracy  measure the integrators, write docs/accuracy.md"
	@echo "make logs      generate the shipped flight logs anew"
	@echo "make docs      build the documentation; open site/index.html"

demo: $(INSTALLED)
	$(BIN)/cfb demo -o out/demo

test: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/python -m pytest -n 2 --dist loadgroup

# What needs little compiling, for while one edits.
FAST = tests/bench tests/commands tests/logs tests/parameters tests/engine/test_scalars.py \
  tests/sweep/test_sweep_config.py tests/test_documents.py tests/test_files.py tests/test_readme.py

test-fast: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/python -m pytest -n 2 --dist loadgroup -q $(FAST)

test-long: $(INSTALLED)
	PLAIN_XLA=1 $(BIN)/python -m pytest -m long

bench: $(INSTALLED) .venv-peers/.installed
	$(BIN)/cfb bench --roofline --peer-python .venv-peers/bin/python --json benchmarks/results.json --markdown docs/performance.md
	$(BIN)/python benchmarks/growth.py

# On a machine with an NVIDIA GPU, jax for CUDA and no network: what it lacks comes along in wheels/.
GPU_PYTHON ?= python3
WHEELS = mujoco mujoco-core mujoco-mjx brax tyro mcap mcap-ros2-support beartype typeguard docstring_parser \
  ml_collections tensorboardX trimesh jaxopt glfw PyOpenGL dm_env

gpu:
	@test ! -d wheels || $(GPU_PYTHON) -m pip install --quiet --no-index --no-deps --upgrade --target .gpu-site wheels/*.whl
	PYTHONPATH=.gpu-site:src $(GPU_PYTHON) scripts/gpu.py

gpu-wheels: $(INSTALLED)
	$(BIN)/python -m pip download --quiet --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
	  --platform manylinux_2_28_x86_64 --platform manylinux2014_x86_64 -c constraints.txt -d wheels $(WHEELS)

accuracy: $(INSTALLED)
	$(BIN)/python scripts/accuracy.py

logs: $(INSTALLED)
	$(BIN)/python scripts/make_flight_logs.py

docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or newer found; install one or say PYTHON=/path/to/python3.11."; exit 1; }
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv --quiet --allow-existing --python "$(PYTHON)" $(VENV) && \
	  uv pip install --quiet --python $(BIN)/python -c constraints.txt -e '.[test]'; \
	else \
	  "$(PYTHON)" -m venv $(VENV) && \
	  $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'; \
	fi
	@touch $@

.venv-peers/.installed: Makefile
	"$(PYTHON)" -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --disable-pip-version-check 'crazyflow==0.4.0' 'l2f==2.0.18'
	@touch $@

clean:
	rm -rf $(VENV) .venv-peers out dist site
