# Two commands for a new user: `make demo` and `make test`. Both set themselves up in .venv.

SHELL := bash
.SHELLFLAGS := -o pipefail -c
VENV ?= .venv
# The ROS 2 Jazzy wheels exist for Python 3.11 and 3.12; the first that runs is taken.
PYTHON ?= $(shell for p in python3.12 python3.11 python3; do \
	$$p -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null \
	&& echo $$p && break; done)
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check
# To people, one line that changes: how many lines pip has printed, and the last.
SHOWN := { n=0; while read -r line; do n=$$((n + 1)); \
	[ ! -t 1 ] || printf '\r\033[K%4d %.70s' $$n "$$line"; done; [ ! -t 1 ] || printf '\r\033[K'; }
BENCH := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python
BENCH_RESULTS := bench/results/bench.json

.PHONY: help demo test lint format docs bench clean

help:  ## Show this help
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(VENV)/ready  ## Drive the paper's figure eight with real ROS 2 nodes
	$(BIN)/adp demo $(if $(OUT),--out $(OUT))

# Each worker imports all tests, each node the package: compiled once, that is half the time.
test: export PYTHONDONTWRITEBYTECODE :=
test: $(VENV)/ready-test  ## Run all tests, those of real nodes too
	$(BIN)/pytest -m "not nodes" -n auto --dist loadfile --no-loadscope-reorder
	$(BIN)/pytest -m nodes -n 6 --dist loadfile --no-loadscope-reorder

lint: $(VENV)/ready-lint  ## Check style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(VENV)/ready-lint  ## Format the code
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(VENV)/ready-test  ## Generate tables in docs/, and the site in build/site
	$(BIN)/adp parameters --format markdown > docs/parameters.md
	$(BIN)/python bench/endurance/faults.py --table
	$(BIN)/python bench/site/hooks.py
	$(BIN)/python bench/site/numbers.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "file://$(CURDIR)/build/site/index.html"

bench: $(VENV)/ready-test  ## Measure ticks, learning steps, simulation and the node
	@rm -f $(BENCH_RESULTS)
	$(BENCH) bench/speed/tick.py --json $(BENCH_RESULTS)
	$(BENCH) bench/speed/policy.py --json $(BENCH_RESULTS) --figure docs/images/learning_step.png
	$(BENCH) bench/speed/simulation.py --json $(BENCH_RESULTS)
	$(BENCH) bench/speed/node.py --json $(BENCH_RESULTS)
	@$(BENCH) bench/speed/timing.py $(BENCH_RESULTS)

clean:  ## Remove the virtual environment and what tools left behind
	rm -rf $(VENV) build install log *.egg-info .mypy_cache .pytest_cache .ruff_cache

$(VENV)/ready: setup.py adp_path_follower/__init__.py
	@test -n "$(PYTHON)" || { echo "make: no Python 3.11 or 3.12 found: install one, or say make PYTHON=..."; exit 1; }
	@echo "Setting up $(VENV): ROS 2 Jazzy and the Python packages, about a minute"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) -e '.[jazzy,optimum,report]' | $(SHOWN)
	@touch $@

$(VENV)/ready-test: $(VENV)/ready
	@echo "Adding what sweeps and tests need"
	@$(PIP) -e '.[sweep,test,docs]' | $(SHOWN)
	@touch $@

$(VENV)/ready-lint: $(VENV)/ready-test
	@$(PIP) -e '.[lint]' | $(SHOWN)
	@touch $@
