# `make run` and `make test` are all that is needed; `make` alone lists the rest.

VENV ?= .venv
RECORDING ?= $(firstword $(wildcard sample_data/*.mcap))
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	$$python -c '$(FITS)' 2>/dev/null && echo $$python && break; done)

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
# Wheels only: nothing is compiled, so no compiler is needed.
INSTALL := $(PIP) install --require-hashes --only-binary :all:

.DEFAULT_GOAL := help
.PHONY: help run install test check docs pictures bench peers bench-peers image-test lock clean

help: ## List these targets.
	@sed -n 's/^\([a-z-]*\):.*## /make \1\t/p' Makefile | expand -t 20

run: install ## Open the workbench on RECORDING; by default the one in sample_data/.
	$(BIN)/hemislam serve $(RECORDING)

install: $(VENV)/.installed ## Install what is needed to run into .venv/.

test: $(VENV)/.installed-dev ## Run the tests.
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder

check: $(VENV)/.installed-dev ## Check format, lint, types and the direction of imports.
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.installed-dev ## Build the documentation as a site in build/site/.
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

pictures: $(VENV)/.installed-dev ## Make every picture of docs/ and the README again; needs chromium.
	$(BIN)/python docs/pictures.py

bench: $(VENV)/.installed-dev ## Time the engine stage by stage and the page; adds to benchmarks/results.csv.
	$(BIN)/python -m benchmarks

peers: $(VENV)/.installed-dev ## Install other odometries from PyPI, for evaluate --baseline.
	$(PIP) install --quiet --upgrade --no-warn-conflicts --only-binary :all: --target build/peers $(PEERS)
# In a folder of their own: some want other versions of what hemislam uses.
PEERS := 'kiss-icp>=1.3' 'rko_lio>=0.4' 'genz-icp>=0.3' 'pypatchworkpp>=1.4'

bench-peers: peers ## Time and score of another ground segmentation from PyPI on the same recordings.
	$(BIN)/python -m benchmarks.peers

image-test: ## Build the Docker image with buildah and run it; needs root, buildah and debootstrap.
	tests/image/build_and_run.sh

lock: $(VENV)/.installed-dev ## Resolve the dependencies again and write the hashed requirements*.txt.
	$(PIP) install --quiet uv
	$(BIN)/uv pip compile $(COMPILE) pyproject.toml --output-file requirements.txt
	$(BIN)/uv pip compile $(COMPILE) --extra dev --constraint requirements.txt pyproject.toml \
		--output-file requirements-dev.txt
COMPILE := --quiet --upgrade --universal --generate-hashes --no-emit-index-url --no-annotate --no-header

clean: ## Remove what was installed and made, but no recordings and no results.
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find app tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

# --- the environment -------------------------------------------------------------------------------
$(BIN)/python:
	@$(or $(PYTHON),false) -c '$(FITS)' 2>/dev/null || { \
		echo "hemislam needs Python 3.11, 3.12 or 3.13; install one, or name it: make PYTHON=/path/to/python3.11" >&2; \
		exit 2; }
	@$(PYTHON) -m venv $(VENV) || { rm -f $@; \
		echo "$(PYTHON) cannot make environments; on Debian: apt install python3-venv" >&2; exit 2; }

$(VENV)/.installed: requirements.txt pyproject.toml | $(BIN)/python
	$(INSTALL) -r requirements.txt
	$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.installed-dev: requirements-dev.txt $(VENV)/.installed
	$(INSTALL) -r requirements-dev.txt
	@touch $@
