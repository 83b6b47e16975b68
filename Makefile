# Everything runs inside .venv, which is made on first use from pyproject.toml and constraints.txt.
# Python 3.11 or newer, with its venv module, is all that has to be there: PYTHON=python3.12 make test
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One thread for each process: the test suite runs in two of them.
export OMP_NUM_THREADS ?= 1
# No advertisement in the output of mkdocs.
export NO_MKDOCS_2_WARNING := 1
TEST_PROCESSES ?= 2
# The tests of a file stay in one process, which makes what they share once. Files keep their order, in
# which those with few and long tests are not the last, when one process would wait for the other. glibc
# keeps what tensors leave free: half of the time of the system went into giving it back and having it anew.
PYTEST := MALLOC_TRIM_THRESHOLD_=268435456 MALLOC_MMAP_THRESHOLD_=33554432 \
          $(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder
# The suite starts many processes: they share compiled modules.
unexport PYTHONDONTWRITEBYTECODE

.DELETE_ON_ERROR:
.PHONY: help demo test test-quick fuzz wheel lint format docs docs-serve install clean

help:
	@echo "make demo       track the animated performer, and a walk in three cameras; see demo-output/"
	@echo "make test       run the tests"
	@echo "make test-quick run those that take less than a minute: foundations, mathematics, structure"
	@echo "make fuzz       damage files for a minute; none may end in anything but a typed error"
	@echo "make wheel      build the wheel, and use it in an environment of its own"
	@echo "make lint       ruff, mypy, and who may import whom"
	@echo "make docs       build the documentation into site/, warnings are errors"
	@echo "make docs-serve show the documentation while it is edited"
	@echo "make format     format the code"
	@echo "make clean      remove the environment and everything that was built"

demo: $(VENV)/.installed-plots
	$(BIN)/torchpose demo --out demo-output
	$(BIN)/torchpose demo --input walk --out demo-output/walk

test: $(VENV)/.installed-dev
	$(PYTEST) $(PYTEST_ARGS)

# What most changes break first, and nothing that tracks more than a few frames.
QUICK := tests/_core tests/math tests/skeleton tests/camera tests/metrics tests/docs/test_reference.py \
         tests/test_import.py tests/test_structure.py
test-quick: $(VENV)/.installed-dev
	$(PYTEST) -m "not slow and not data" $(PYTEST_ARGS) $(QUICK)

FUZZ_SECONDS ?= 60
FUZZ_SEED ?= 0
fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m tests.fuzz --seconds $(FUZZ_SECONDS) --seed $(FUZZ_SEED)

wheel:
	PYTHON="$(PYTHON)" .ci/wheel

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.installed-dev
	$(BIN)/mkdocs build --strict

docs-serve: $(VENV)/.installed-dev
	$(BIN)/mkdocs serve

install: $(VENV)/.installed-dev

PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt

# The stamps are written last. An installation that was killed leaves .installing behind, with the id
# of its process, and the next one starts with a new environment. The pip of constraints.txt takes half the
# time of the one that comes with Python 3.11. It would compile one module after the other, in one process;
# a few modules of other libraries are for other versions of Python. Of the unused ones hardly any is ever
# imported; Python compiles these then.
UNUSED := tests?|_inductor|_vendor|aiohttp|fontTools|grpc|kornia|lightning_fabric|mypyc?|networkx
UNUSED := $(UNUSED)|onnxruntime|pip|pygments|pytorch_lightning|setuptools|tensorboard|testing|torchgen
UNUSED := $(UNUSED)|claw|distutils|elastic|ensemble|hipify|idna|implementations|parsing|physics|pipelining
UNUSED := $(UNUSED)|pyprima|reference|requests|unidata|urllib3|watchdog|werkzeug
$(VENV)/.installed-%: pyproject.toml constraints.txt
	@set -e; \
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "torchpose needs Python 3.11 or newer: PYTHON=/path/to/python make" >&2; exit 1; }; \
	if [ -e $(VENV)/.installing ] && kill -0 "$$(cat $(VENV)/.installing)" 2>/dev/null; then \
	    echo "another installation into $(VENV) is under way; try again when it is done" >&2; exit 1; fi; \
	if [ -e $(VENV)/.installing ] || ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
	    $(PYTHON) -m venv --clear $(VENV); fi; \
	echo $$$$ > $(VENV)/.installing; \
	echo "installing torchpose[$*] into $(VENV)"; \
	$(PIP_INSTALL) pip; \
	$(PIP_INSTALL) -e '.[$*]'; \
	$(BIN)/python -m compileall -qq -j 0 -x '/($(UNUSED))/' $(VENV)/lib || true; \
	touch $@; \
	rm $(VENV)/.installing

# Development includes what the demo needs.
ifneq ($(wildcard $(VENV)/.installed-dev),)
$(VENV)/.installed-plots: $(VENV)/.installed-dev
	@touch $@
endif

clean:
	rm -rf $(VENV) site demo-output build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
