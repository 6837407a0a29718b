# `make demo` and `make test` need python3 (3.11 or newer), its venv module and make. They install the
# locked packages to .venv, and again if pyproject.toml or a lock file changes.

PYTHON ?= python3
PACKAGES := cli api report daemon identification drivers sim log wire model config

# Containers often forbid Python to keep bytecode; tests start Python some thousand times, and each would compile
# numpy and scipy anew.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
BIN := $(VENV)/bin
RUNTIME := $(VENV)/.installed-runtime
DEV := $(VENV)/.installed-dev

.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: help demo test test-long test-beside test-rest test-rig bench lint docs format lock clean

help:
	@echo "make demo      fly, identify and trace the simulated rig; print the paths of the reports"
	@echo "make test      run the tests, about twenty minutes on two processors"
	@echo "make test-long run the long tests: processes killed in flight, many traces; about seven minutes"
	@echo "make test-rig  run the daemon on vcan in a virtual machine, also as a service (Debian, Ubuntu; root)"
	@echo "make bench     run every benchmark with --quick"
	@echo "make docs      build the documentation site into build/site"
	@echo "make lint      run ruff, mypy and import-linter"
	@echo "make format    format the code and sort imports with ruff"
	@echo "make lock      update the lock files from pyproject.toml (delete them first to upgrade packages)"
	@echo "make clean     remove .venv, build/ and caches"

demo: $(RUNTIME)
	@$(BIN)/levid demo

# Computational tests run in parallel, one thread each, on processor time that is left by the tests that depend on
# clocks, processes or buses (marker `alone`), which run one at a time and wait most of it.
IN_PARALLEL = OPENBLAS_NUM_THREADS=1 $(IDLE) $(BIN)/python -m pytest \
  --numprocesses auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations 15
IDLE := $(shell chrt --idle 0 true 2> /dev/null && echo chrt --idle 0 || echo nice -n 19)

test: COMPUTING = not alone and not long
test: WAITING = alone and not long
test-long: COMPUTING = long and not alone
test-long: WAITING = long and alone
test-rest: COMPUTING = not alone and not long
test-rest: WAITING = alone

test test-long test-rest: $(DEV)
	@mkdir -p build
	@$(IN_PARALLEL) -m "$(COMPUTING)" > build/$@.txt 2>&1 & computing=$$!; failed=0; \
	$(BIN)/python -m pytest --durations 15 -m "$(WAITING)" || failed=$$?; \
	echo "... and the tests that ran beside these:"; \
	wait $$computing || failed=$$?; cat build/$@.txt; exit $$failed

# `test` and `test-long` in two parts. .ci/run runs the first, one process that only computes, beside a virtual machine:
# more would take it the processor's caches.
test-beside: $(DEV)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses 2 --dist worksteal --durations 15 \
	  -m "long and not alone"

test-rig: $(DEV)
	@bash tests/rig_vm/boot.sh

# Warnings are errors: a link that leads nowhere, a page that no table of contents lists.
docs: $(DEV) build/typecheck/levid
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs build/site
	@echo "build/site/index.html"

bench: $(DEV)
	@failed=; for file in $$(grep -lE "benchmark_runner|show_plants" $$(grep -l __main__ benchmarks/*/*.py)); do \
	  echo "== $$file"; $(BIN)/python "$$file" --quick || failed="$$failed $$file"; \
	done; \
	if [ -n "$$failed" ]; then echo "benchmarks that failed:$$failed" >&2; exit 1; fi

lint: $(DEV) build/typecheck/levid
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	MYPYPATH=build/typecheck $(BIN)/mypy $(addprefix -p levid.,$(PACKAGES))
	$(BIN)/lint-imports --no-logo

format: $(DEV)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# mypy names modules by folder: this link is always named levid, whatever the clone's folder is named.
build/typecheck/levid:
	@mkdir -p $(@D)
	@ln -sfn ../.. $@

# --only-binary: a missing wheel is an error; pip does not compile packages from source.
# --no-compile: Python writes bytecode at import; compiling everything takes a third longer.
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

# A venv contains its absolute path and a link to its Python. It is created again if the clone was
# copied or moved, or if its Python is missing.
ifeq ($(shell test -x $(BIN)/python && grep -F "$(CURDIR)/$(VENV)" $(BIN)/activate),)
.PHONY: $(BIN)/python
endif

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { \
	  echo "levid needs Python 3.11 or newer; $(PYTHON) was not found." >&2; \
	  echo "On Debian and Ubuntu: sudo apt install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "levid needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	  echo "To use another one: make $(MAKECMDGOALS) PYTHON=/path/to/python3" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "$(PYTHON) has no venv module. On Debian and Ubuntu: sudo apt install python3-venv" >&2; \
	  exit 1; }
	@if [ -L $(VENV) ]; then rm $(VENV); fi  # remove a link, not the venv that it points to
	@$(PYTHON) -m venv --clear $(VENV)

# uv resolves one set of versions for all supported Python versions and platforms.
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
