# levid: `make demo` and `make test` need python3 (3.11 or newer), its venv module and make.
# They install into .venv from the lock files, again only when pyproject.toml or a lock has changed.

PYTHON ?= python3
PACKAGES := cli report daemon identification drivers sim log wire model config

VENV := .venv
BIN := $(VENV)/bin
RUNTIME := $(VENV)/.installed-runtime
DEV := $(VENV)/.installed-dev

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo test test-rig bench lint format lock clean

help:
	@echo "make demo    fly the simulated rig, identify it, say where the report lies"
	@echo "make test    run the tests"
	@echo "make test-rig  boot a Linux with vcan, fly on it, also as a service (Debian or Ubuntu, root)"
	@echo "make bench   run every benchmark, quickly"
	@echo "make lint    ruff, mypy and the import arrows"
	@echo "make format  let ruff format and sort"
	@echo "make lock    write the lock files anew from pyproject.toml (remove them first to upgrade)"
	@echo "make clean   remove .venv, build/ and the caches"

demo: $(RUNTIME)
	@$(BIN)/levid demo

# What only computes runs on several processors, with one thread each; what waits for clocks, processes
# and buses by itself, after it.
test: $(DEV)
	@failed=0; \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m "not alone" \
	  --numprocesses auto --maxprocesses 4 --dist loadfile || failed=$$?; \
	$(BIN)/python -m pytest -m alone && exit $$failed

test-rig: $(DEV)
	@bash tests/rig_vm/boot.sh

bench: $(DEV)
	@failed=; for file in $$(grep -l __main__ benchmarks/*/*.py); do \
	  echo "== $$file"; $(BIN)/python "$$file" --quick || failed="$$failed $$file"; \
	done; \
	if [ -n "$$failed" ]; then echo "These did not come to their end:$$failed" >&2; exit 1; fi

lint: $(DEV) build/typecheck/levid
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	MYPYPATH=build/typecheck $(BIN)/mypy $(addprefix -p levid.,$(PACKAGES))
	$(BIN)/lint-imports --no-logo

format: $(DEV)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# mypy names modules by folders, and a clone may be called anything: here it is always called levid.
build/typecheck/levid:
	@mkdir -p $(@D)
	@ln -sfn ../.. $@

# --only-binary: a missing wheel is an error that says so, never an attempt to compile it from source.
# --no-compile: Python writes the bytecode of what is imported; writing all of it takes a third longer.
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
FROM_LOCK := $(PIP) install --quiet --no-compile --only-binary :all: --requirement
EDITABLE := $(PIP) install --quiet --no-deps --no-build-isolation --editable .

$(RUNTIME): pyproject.toml requirements.lock $(BIN)/python
	@echo "Installing levid into $(VENV), about a minute the first time ..."
	@$(FROM_LOCK) requirements.lock
	@$(EDITABLE)
	@touch $@

$(DEV): pyproject.toml requirements-dev.lock $(BIN)/python
	@echo "Installing levid and its test tools into $(VENV), about a minute the first time ..."
	@$(FROM_LOCK) requirements-dev.lock
	@$(EDITABLE)
	@touch $(RUNTIME) $@

# A venv holds its absolute path and a link to its Python: one that came along with a copied or moved
# clone, or whose Python is gone, is made anew.
ifeq ($(shell test -x $(BIN)/python && grep -F "$(CURDIR)/$(VENV)" $(BIN)/activate),)
.PHONY: $(BIN)/python
endif

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { \
	  echo "levid needs Python 3.11 or newer, and there is no $(PYTHON) here." >&2; \
	  echo "On Debian and Ubuntu: sudo apt install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "levid needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	  echo "Name a newer one: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "$(PYTHON) has no venv module. On Debian and Ubuntu: sudo apt install python3-venv" >&2; \
	  exit 1; }
	@if [ -L $(VENV) ]; then rm $(VENV); fi  # a link leads to somebody else's: that one stays
	@$(PYTHON) -m venv --clear $(VENV)

# uv resolves for every Python and platform at once, so that one set of versions serves them all.
UV := build/lock/bin/uv
COMPILE := $(UV) pip compile --quiet --universal --fork-strategy fewest --no-header

lock: $(UV)
	$(COMPILE) pyproject.toml --group build --output-file requirements.lock
	$(COMPILE) pyproject.toml --group build --extra dev --constraints requirements.lock \
	  --output-file requirements-dev.lock

$(UV):
	@$(PYTHON) -m venv --clear build/lock
	@build/lock/bin/python -m pip install --quiet uv

clean:
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
