# `make demo` on a fresh machine needs Python 3.11 and nothing else; `make` alone lists the targets.
PYTHON ?= $(firstword $(shell command -v python3.11 python3.12 python3.13 python3))
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.DEFAULT_GOAL := help
.PHONY: help demo serve test static check bench lock clean

help: ## Show the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

$(VENV)/.runtime: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --require-hashes -r requirements.txt
	$(PIP) install --quiet --no-deps -e .
	$(BIN)/python -m app.jobs.compile_kernels  # once for all processes
	@touch $@

$(VENV)/.dev: requirements-dev.txt $(VENV)/.runtime
	$(PIP) install --quiet --require-hashes -r requirements-dev.txt
	@touch $@

demo: $(VENV)/.runtime ## From coordinates, meanings and a road to decoded drives and a proved plan, in four tables
	$(BIN)/waymark demo

serve: $(VENV)/.runtime ## Serve on http://127.0.0.1:8000
	$(BIN)/waymark serve

test: $(VENV)/.dev ## All tests
	$(BIN)/python -m pytest -n 4 --dist worksteal --durations=30 $(PYTEST_ARGS)

static: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: static test ## Format, lint, types, import contracts, tests

bench: $(VENV)/.dev ## Benchmarks beside the paper's figures; SHORT=1 for the quick version
	$(BIN)/python -m benchmarks $(if $(SHORT),--short)

lock: $(VENV)/.dev ## Resolve the dependencies again, with hashes
	$(BIN)/uv pip compile pyproject.toml --group dev --generate-hashes --no-emit-index-url --universal \
		--python-version 3.11 -o requirements-dev.txt
	$(BIN)/uv pip compile pyproject.toml --generate-hashes --no-emit-index-url --universal \
		--python-version 3.11 -o requirements.txt -c requirements-dev.txt
	$(BIN)/uv pip compile pyproject.toml --extra s3 --extra tracing --extra bags --generate-hashes --no-emit-index-url \
		--universal --no-header --python-version 3.11 -o docker/requirements.txt -c requirements-dev.txt

clean: ## Remove what was built
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
