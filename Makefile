# Everything a developer runs. Needs make and Python 3.11 or newer, nothing else.

VENV := .venv
PINS := constraints.txt
EXTRAS := dev
# What ends in -mjx has an environment of its own: MTCWorldMJX needs another MuJoCo than
# metaworld does.
%-mjx %-mjx/.installed: VENV := .venv-mjx
%-mjx %-mjx/.installed: PINS := constraints-mjx.txt
%-mjx %-mjx/.installed: EXTRAS := cw-mjx,test
# What ends in -bench has one with other implementations, to measure beside ours.
%-bench %-bench/.installed: VENV := .venv-bench
%-bench %-bench/.installed: PINS := constraints-bench.txt
%-bench %-bench/.installed: EXTRAS := bench,test

# Deferred: Python is looked for only where it is used.
PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
RUN = $(VENV)/bin/python
# A file's tests share what they train, so they stay in one process.
WORKERS ?= -n 2 --dist loadfile

comma := ,
# $(call option,NAME,VALUE): `--NAME VALUE` where VALUE is set, else nothing.
option = $(if $(strip $(2)),--$(1) $(2))

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup setup-mjx setup-bench lock lock-mjx lock-bench lint format test \
	test-slow test-mjx test-bench bench-brax bench-cw bench-speed bench-mjx readme \
	notebooks docs clean

help: ## Say what there is
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-13s %s\n", $$1, $$2 }' Makefile
	@echo 'bench-brax and bench-cw read SCENARIO METHODS PROFILE SEEDS SEED INTERACTIONS TASKS' \
		'BACKEND OUT KEEP where set, bench-cw REWARD and TRANSFER too, bench-speed PARTS.'

setup: .venv/.installed ## Make .venv with the pinned versions (does nothing when up to date)

setup-mjx: .venv-mjx/.installed ## Make .venv-mjx: Meta-World on MJX-Warp instead of C MuJoCo

setup-bench: .venv-bench/.installed ## Make .venv-bench: with what bench-speed compares to

# An environment that can run pip is kept, anything else is made anew.
define make_venv
@$(RUN) -m pip --version >/dev/null 2>&1 || { \
	"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo 'error: "$(PYTHON)" is not Python 3.11 or newer;' \
			'name one: make setup PYTHON=/path/to/python3.11' >&2; \
		exit 1; }; \
	echo 'Making $(VENV)'; \
	"$(PYTHON)" -m venv --clear $(VENV); }
endef

.venv/.installed: constraints.txt
.venv-mjx/.installed: constraints-mjx.txt
.venv-bench/.installed: constraints-bench.txt
.venv/.installed .venv-mjx/.installed .venv-bench/.installed: pyproject.toml
	$(make_venv)
	$(RUN) -m pip install --quiet --disable-pip-version-check \
		-c $(PINS) -e '.[$(EXTRAS)]'
	@touch $@

# Pins that are there stay; `make lock UPGRADE=1` looks for newer versions.
lock: ## Resolve the dependencies anew into constraints.txt (UPGRADE=1: newest)
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
        # A build's own suffix, as of PyTorch for a CPU, is not found everywhere.
        print(package["name"] + "==" + package["version"].split("+")[0])
endef
export LOCK

lint: setup ## Check style, format, types and which room imports which
	$(VENV)/bin/lint-imports
	$(RUN) -m ruff check
	$(RUN) -m ruff format --check
	$(RUN) -m mypy rewire_jax experiments docs notebooks

format: setup ## Mend what ruff can mend
	$(RUN) -m ruff check --fix
	$(RUN) -m ruff format

test: lint ## Set up, lint, run all tests but the slow ones
	$(RUN) -m pytest -m 'not slow' $(WORKERS)

test-slow: setup ## Run the slow tests
	$(RUN) -m pytest -m slow $(WORKERS)

test-mjx: setup-mjx ## Run the tests of Meta-World on MJX-Warp (compiles for minutes at first)
	$(RUN) -m pytest tests/envs/test_metaworld_mjx.py

test-bench: setup-bench ## Run the tests of what bench-speed compares to
	$(RUN) -m pytest tests/experiments/test_bench_peers.py

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

bench-brax: setup ## Run the methods on a Brax scenario, make its table and figures
	$(RUN) -m experiments.bench_brax $(bench_options)

bench-cw: setup ## The same on a Continual World scenario (TRANSFER=1: and each task alone)
	$(RUN) -m experiments.bench_cw $(strip $(bench_options) \
		$(call option,reward,$(REWARD)) \
		$(if $(TRANSFER),--transfer))

bench-speed: setup ## Measure what is fast and slow, and peers after setup-bench
	$(if $(wildcard .venv-bench/.installed),.venv-bench/bin/python,$(RUN)) \
		-m experiments.bench_speed $(call option,parts,$(subst $(comma), ,$(PARTS)))

bench-mjx: setup-mjx ## Measure steps a second of Meta-World on MJX-Warp
	$(RUN) -m experiments.bench_mjx

readme: setup ## Make the tables of README.md and docs anew from experiments/results
	$(RUN) -m experiments.readme


notebooks: setup ## Execute the notebooks anew, in place
	$(RUN) -m notebooks.execute

docs: setup ## Build the documentation into site/, warnings being errors
	$(RUN) -m sphinx --fail-on-warning --keep-going --quiet --fresh-env \
		--doctree-dir build/doctrees docs site
	@echo 'open site/index.html'

clean: ## Remove caches and build outputs; .venv and runs/ stay
	rm -rf .jax_cache .mypy_cache .pytest_cache .ruff_cache build dist site \
		docs/drawings docs/notebooks *.egg-info
	find rewire_jax experiments docs notebooks tests -name __pycache__ -type d -prune -exec rm -rf {} +
