# Everything a developer runs. Needs make and Python 3.11 to 3.13, nothing else.

VENV := .venv
PINS := constraints.txt
EXTRAS := dev
# Targets that end in -mjx have their own virtual environment: MTCWorldMJX and metaworld
# need different versions of MuJoCo.
%-mjx %-mjx/.installed: VENV := .venv-mjx
%-mjx %-mjx/.installed: PINS := constraints-mjx.txt
%-mjx %-mjx/.installed: EXTRAS := cw-mjx,test
# Targets that end in -bench have their own virtual environment with other
# implementations, to compare speeds.
%-bench %-bench/.installed: VENV := .venv-bench
%-bench %-bench/.installed: PINS := constraints-bench.txt
%-bench %-bench/.installed: EXTRAS := bench,test
# Targets that end in -latest have their own virtual environment with the newest versions
# that pyproject.toml allows. Since 0.11, JAX needs Python 3.12 or newer.
%-latest %-latest/.installed: VENV := .venv-latest
%-latest %-latest/.installed: PINS :=
%-latest %-latest/.installed: PYTHONS := python3.13 python3.12 python3.11

# The first of these that runs is used.
PYTHONS := python3.11 python3.12 python3.13
# Deferred: Python is searched for only when a target needs it.
PYTHON ?= $(shell for python in $(PYTHONS) python3; do \
	"$$python" -c '' 2>/dev/null && break; done; echo "$$python")
RUN = $(VENV)/bin/python
# A file's tests share what they train, so they stay in one process. tests/conftest.py
# orders the files.
WORKERS ?= -n 2 --dist loadfile --no-loadscope-reorder

comma := ,
# $(call option,NAME,VALUE): `--NAME VALUE` if VALUE is set, else nothing.
option = $(if $(strip $(2)),--$(1) $(2))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup setup-mjx setup-bench setup-latest .venv-latest/.installed lock \
	lock-mjx lock-bench lint format test test-slow test-mjx test-bench test-latest bench-brax bench-cw bench-speed bench-mjx readme \
	notebooks docs clean

help: ## List the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-13s %s\n", $$1, $$2 }' Makefile
	@echo 'Variables: bench-brax and bench-cw read SCENARIO METHODS PROFILE SEEDS SEED' \
		'INTERACTIONS TASKS BACKEND OUT KEEP; bench-cw also REWARD TRANSFER; bench-speed PARTS.'

setup: .venv/.installed ## Create .venv with the pinned versions (does nothing if up to date)

setup-mjx: .venv-mjx/.installed ## Create .venv-mjx, for Meta-World on MJX-Warp instead of C MuJoCo

setup-bench: .venv-bench/.installed ## Create .venv-bench, with the implementations that bench-speed compares

setup-latest: .venv-latest/.installed ## Create or upgrade .venv-latest, with the newest versions that are allowed

# A virtual environment that can run pip is kept. Otherwise it is created again.
define make_venv
@$(RUN) -m pip --version >/dev/null 2>&1 || { \
	"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo 'error: "$(PYTHON)" is not Python 3.11 or newer;' \
			'name one: make setup PYTHON=/path/to/python3.11' >&2; \
		exit 1; }; \
	echo 'Creating $(VENV)'; \
	"$(PYTHON)" -m venv --clear $(VENV); }
endef

.venv/.installed: constraints.txt
.venv-mjx/.installed: constraints-mjx.txt
.venv-bench/.installed: constraints-bench.txt
.venv/.installed .venv-mjx/.installed .venv-bench/.installed .venv-latest/.installed: \
		pyproject.toml
	$(make_venv)
	$(RUN) -m pip install --quiet --disable-pip-version-check \
		$(if $(PINS),-c $(PINS),--upgrade --upgrade-strategy eager) -e '.[$(EXTRAS)]'
	@touch $@

# Keeps existing pins; `make lock UPGRADE=1` looks for newer versions.
lock: ## Resolve the dependencies into constraints.txt; keep existing pins (not with UPGRADE=1)
lock-mjx: ## The same into constraints-mjx.txt
lock-bench: ## The same into constraints-bench.txt
lock lock-mjx lock-bench:
	$(make_venv)
	$(RUN) -m pip install --quiet --disable-pip-version-check \
		--dry-run --ignore-installed --report $(VENV)/lock.json \
		$(if $(UPGRADE),,-c $(PINS)) -e '.[$(EXTRAS)]'
	$(RUN) -c "$$LOCK" $@ <$(VENV)/lock.json >$(VENV)/$(PINS)
	mv $(VENV)/$(PINS) $(PINS)

define LOCK
import json, sys

print(f"# The versions that are tested together. Made by `make {sys.argv[1]}`: do not edit.")
packages = [item["metadata"] for item in json.load(sys.stdin)["install"]]
for package in sorted(packages, key=lambda package: package["name"].lower()):
    if package["name"] != "rewire_jax":
        # Not every index has builds with a suffix, such as PyTorch's for CPUs.
        print(package["name"] + "==" + package["version"].split("+")[0])
endef
export LOCK

lint: setup ## Check style, format, types and imports between layers
	$(VENV)/bin/lint-imports
	$(RUN) -m ruff check
	$(RUN) -m ruff format --check
	$(RUN) -m mypy rewire_jax experiments docs notebooks

format: setup ## Fix what ruff can fix
	$(RUN) -m ruff check --fix
	$(RUN) -m ruff format

test: lint ## Set up, lint, run all tests except the slow ones
	$(RUN) -m pytest -m 'not slow' $(WORKERS)

test-slow: setup ## Run the slow tests
	$(RUN) -m pytest -m slow $(WORKERS)

test-mjx: setup-mjx ## Run the tests of Meta-World on MJX-Warp (the first run compiles for minutes)
	$(RUN) -m pytest tests/envs/test_metaworld_mjx.py

test-bench: setup-bench ## Run the tests of the implementations that bench-speed compares
	$(RUN) -m pytest tests/experiments/test_bench_peers.py

test-latest: setup-latest ## Run all tests except the slow ones with the newest versions that are allowed
	$(RUN) -m pytest -m 'not slow' $(WORKERS)
	$(RUN) -m pytest -m slow tests/docs/test_packaging.py

bench_options = $(strip \
	$(call option,scenario,$(SCENARIO)) \
	$(call option,methods,$(subst $(comma), ,$(METHODS))) \
	$(call option,profile,$(PROFILE)) \
	$(call option,seeds,$(SEEDS)) \
	$(call option,seed,$(SEED)) \
	$(call option,interactions,$(INTERACTIONS)) \
	$(call option,tasks,$(TASKS)) \
	$(call option,backend,$(BACKEND)) \
	$(call option,out,$(OUT)) \
	$(if $(KEEP),--keep))

# Without another profile, it ends in minutes.
bench-brax: TASKS ?= $(if $(PROFILE),,2)
bench-brax: INTERACTIONS ?= $(if $(PROFILE),,64000)
bench-brax: setup ## Run the methods on a Brax scenario (two short tasks; see TASKS, INTERACTIONS), write tables and plots
	$(RUN) -m experiments.bench_brax $(bench_options)

bench-cw: setup ## The same on a Continual World scenario (TRANSFER=1: also on each single task)
	$(RUN) -m experiments.bench_cw $(strip $(bench_options) \
		$(call option,reward,$(REWARD)) \
		$(if $(TRANSFER),--transfer))

bench-speed: setup ## Measure speeds; after setup-bench also of other implementations
	$(if $(wildcard .venv-bench/.installed),.venv-bench/bin/python,$(RUN)) \
		-m experiments.bench_speed $(call option,parts,$(subst $(comma), ,$(PARTS)))

bench-mjx: setup-mjx ## Measure steps per second of Meta-World on MJX-Warp
	$(RUN) -m experiments.bench_mjx

readme: setup ## Copy tables from experiments/results into README.md and docs
	$(RUN) -m experiments.readme

notebooks: setup ## Execute the notebooks in place
	$(RUN) -m notebooks.execute

docs: setup ## Build the documentation into site/; a warning is an error
	$(RUN) -m sphinx --fail-on-warning --keep-going --quiet --fresh-env \
		--doctree-dir build/doctrees docs site
	@echo 'open site/index.html'

clean: ## Remove caches and build outputs; .venv and runs/ stay
	rm -rf .jax_cache .mypy_cache .pytest_cache .ruff_cache build dist site \
		docs/notebooks jupyter_execute *.egg-info
	find rewire_jax experiments docs notebooks tests -name __pycache__ -type d -prune -exec rm -rf {} +
