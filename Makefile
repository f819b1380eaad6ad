# Two commands for people: `make demo` and `make test`. Both set up .venv themselves, with pinned versions.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup demo test test-slow lint format proto clean
help:            ## this list
	@grep -hE '^[a-z-]+: .*##|^[a-z-]+:  *##' $(MAKEFILE_LIST) | sed -E 's/:.*##/:/' | sort

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("CABLE-RPC needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; try make PYTHON=python3.12") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[cloud,study,trial,tracing,dev]'
	@touch $@

setup: $(READY)  ## make .venv and install everything, pinned

demo: $(READY)   ## stream a driving clip edge -> cloud -> edge over loopback; writes out/demo
	$(BIN)/cable-rpc demo --out out/demo

test: $(READY)   ## all checks and tests (under 8 minutes on 2 cores)
	$(BIN)/python -m pytest -n auto --dist loadscope

test-slow: $(READY)  ## the slower checks
	$(BIN)/python -m pytest -m slow --timeout 1800

lint: $(READY)   ## style and types
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

format: $(READY) ## apply the style
	$(BIN)/ruff check --fix . && $(BIN)/ruff format .

proto:           ## regenerate the gRPC stubs with the pinned generator
	$(PYTHON) -m venv .venv/proto
	.venv/proto/bin/python -m pip install --quiet -r proto/requirements.txt
	.venv/proto/bin/python proto/generate.py

clean:           ## remove what make made
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache
