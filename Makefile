# calibgraph: `make run` shows what it does, `make test` checks it. Both set up .venv themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# The processes share the cores: threads of OpenMP that wait for work do not spin.
PYTEST := OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive $(BIN)/python -m pytest --numprocesses auto --dist worksteal

# Compiled modules are kept also where the environment forbids it: each process would compile them all.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help install run test coverage test-ci test-slow lint type docs bench clean

help: ## Show this list
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

TEST := [test,simulation,learned,ros,fleet,service]
DOCS := $(TEST:]=,docs])

# One call of pip, and modules are compiled on all cores; those of other versions of Python cannot be.
define install
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "calibgraph needs Python 3.11 or newer, $(PYTHON) is %d.%d; try make PYTHON=python3.11" % v[:2])'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt --editable '.$(1)'
	$(BIN)/python -m compileall -qq -j 0 $(VENV)/lib || true
endef

$(VENV)/base: pyproject.toml constraints.txt
	$(call install)
	@touch $@

$(VENV)/test: pyproject.toml constraints.txt
	$(call install,$(TEST))
	@touch $(VENV)/base $@

install: $(VENV)/base ## Install into .venv

run: $(VENV)/base ## Calibrate the sample rig: three cameras, six frames
	$(BIN)/calibgraph calibrate data/sample --out out/sample
	$(BIN)/calibgraph evaluate out/sample data/sample/reference.yaml

test: $(VENV)/test ## Run the tests
	$(PYTEST)

coverage: $(VENV)/test ## Measure the branches of graph, solver, trust and factors that their tests reach
	$(PYTEST) --cov --cov-report term tests/factors tests/graph tests/solver tests/trust

test-ci: $(VENV)/test ## Run the tests and a short choice of the slow ones
	$(PYTEST) -m "ci or not (slow or realdata or statistics)"

test-slow: $(VENV)/test ## Run the slow tests, on real data too, and the statistics (many minutes)
	$(PYTEST) -m "slow or realdata or statistics"

lint: type ## Check style, types and the layers
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

type: $(VENV)/test ## Check types
	$(BIN)/mypy

$(VENV)/docs: pyproject.toml constraints.txt
	$(call install,$(DOCS))
	@touch $(VENV)/base $(VENV)/test $@

docs: $(VENV)/docs ## Build the documentation into build/docs, without a network
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(VENV)/test ## Compare ratios of processor times with the last release's; time updates while driving
	$(BIN)/python -m benchmarks.speed.gate --against benchmarks/ratios.json
	$(BIN)/python -m benchmarks.speed.incremental

clean: ## Remove everything that was made
	rm -rf $(VENV) out build *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
