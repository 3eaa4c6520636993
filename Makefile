# `make demo` on a fresh machine needs Python 3.11 and nothing else; `make` alone lists the targets.
PYTHON ?= $(firstword $(shell command -v python3.11 python3.12 python3.13 python3))
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

# Byte code is kept: without it every process compiles the sources anew, and pytest rewrites every test.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help demo serve test slow static web check bench docs lock clean

help: ## Show the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

$(VENV)/.runtime: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --require-hashes -r requirements.txt
	$(PIP) install --quiet --no-deps -e .
	$(BIN)/waymark compile  # once for all processes
	@touch $@

$(VENV)/.dev: requirements-dev.txt $(VENV)/.runtime
	$(PIP) install --quiet --require-hashes -r requirements-dev.txt
	@touch $@

demo: $(VENV)/.runtime ## From coordinates, meanings and a road to decoded drives and a proved plan, in four tables
	$(BIN)/waymark demo

serve: $(VENV)/.runtime ## Serve on http://127.0.0.1:8000
	$(BIN)/waymark serve

PYTEST := $(BIN)/python -m pytest --durations=30

# A process for each core, each of which imports everything: 50 CPU seconds. Slow tests wait for other processes.
# QUICK names files, if only their quick tests are to be run.
test: $(VENV)/.dev ## The quick tests; `make check` runs all
	$(PYTEST) -n logical --dist worksteal -m "not slow" -p no:schemathesis $(QUICK) $(PYTEST_ARGS)

slow: $(VENV)/.dev
	$(PYTEST) -n 4 --dist loadfile -m slow $(PYTEST_ARGS)

static: $(VENV)/.dev web
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

web: $(VENV)/.dev
	@if command -v npm > /dev/null; then \
		$(MAKE) --no-print-directory node_modules/.installed && node_modules/.bin/tsc -p . \
			&& $(BIN)/python -m tests.web.api_types --check; \
	elif [ -n "$$CI" ]; then \
		echo "make web: npm is not installed" >&2; exit 1; \
	else \
		echo "The types of the web pages are not checked: that needs node and npm, see docs/web-pages.md."; \
	fi

node_modules/.installed: package-lock.json .npmrc
	npm ci --no-audit --no-fund --loglevel=error
	@touch $@

check: static test slow ## Format, lint, types, import contracts, all tests

bench: $(VENV)/.dev ## Benchmarks beside the paper's figures; SHORT=1 for the quick version
	$(BIN)/python -m benchmarks $(if $(SHORT),--short)

docs: $(VENV)/.dev ## The guide, from docs/ into build/guide; the server shows it at /guide
	$(BIN)/python -m guide

lock: $(VENV)/.dev ## Resolve the dependencies again, with hashes
	$(BIN)/uv pip compile pyproject.toml --group dev --generate-hashes --no-emit-index-url --universal \
		--python-version 3.11 -o requirements-dev.txt
	$(BIN)/uv pip compile pyproject.toml --generate-hashes --no-emit-index-url --universal \
		--python-version 3.11 -o requirements.txt -c requirements-dev.txt
	$(BIN)/uv pip compile pyproject.toml --all-extras --generate-hashes --no-emit-index-url \
		--universal --no-header --python-version 3.11 -o docker/requirements.txt -c requirements-dev.txt
	for group in build guide; do \
		$(BIN)/uv pip compile --group $$group --generate-hashes --no-emit-index-url --universal --no-header \
			--python-version 3.11 -o docker/requirements-$$group.txt -c requirements-dev.txt || exit 1; \
	done

clean: ## Remove what was built
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
