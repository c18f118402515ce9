# SPDX-License-Identifier: Apache-2.0
# Every target makes .venv from constraints.txt if it is missing or older than the list of packages.

SHELL := /bin/sh
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo real sweeps right-time source-faults faults plug-and-play bench bench-accuracy bench-pipeline bench-board bench-master bench-scale bench-latency soak bench-pose-monitor bench-paper viewer-test rehearsal image-test fresh-machine pictures docs test lint clean

ARGS ?=
MINUTES ?= 30
EXTRAS := edge,master,realsense,sim,dev
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest -q
# Number of parallel tests: one per core. Tests that need a quiet machine (marker "alone") run one by one.
WORKERS ?= logical
# Exit code of pytest if ARGS selects no test.
NO_TESTS := 5
READY := $(VENV)/ready
BENCH_READY := $(VENV)/ready-bench
DOCS_READY := $(VENV)/ready-docs
TYPED := $(patsubst %/,%,$(dir $(wildcard $(addsuffix /__init__.py,shared geometry edge_unit master_server simulation benchmarks qualification))))
SCRIPTS := $(wildcard scripts/*.py examples/*.py examples/*/*.py)

# Recorded data beside the checkout, if it exists.
ifneq ($(wildcard ../shared/data),)
export CELLWATCH_DATA ?= $(abspath ../shared/data)
endif

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1 \t\2/p' Makefile | expand -t 24
	@echo 'Arguments go through ARGS: make demo ARGS="--seconds 20". Another Python: make PYTHON=python3.12 ...'

demo: $(READY) ## a simulated cell with a moving robot, people and many cameras
	@$(BIN)/python -m simulation.demo $(ARGS)

real: $(READY) ## the filter on recorded frames of a real cell (in the folder CELLWATCH_DATA)
	@$(BIN)/python -m benchmarks.real $(ARGS)

sweeps: $(READY) ## limits of the filter with simulated cameras: thin things, small things, empty cells
	@$(BIN)/python -m benchmarks.sweeps $(ARGS)

right-time: $(READY) ## filtering of the robot with late, jittering and rare joints
	@$(BIN)/python -m benchmarks.right_time $(ARGS)

source-faults: $(READY) ## time to recover for a RealSense camera that hangs, dies or is unplugged
	@$(BIN)/python -m qualification.source_faults $(ARGS)

faults: $(READY) ## the map while units, master, networks, clocks and disks fail
	@$(BIN)/python -m qualification.faults $(ARGS)

plug-and-play: $(READY) ## four units with only a token: plugged in, moved, exchanged, knocked and covered
	@$(BIN)/python -m qualification.plug_and_play $(ARGS)

bench: $(BENCH_READY) ## main figures, measured again in some 20 minutes: out/REPORT.md
	@$(BIN)/python -m benchmarks.bench $(ARGS)

bench-accuracy: $(READY) ## accuracy against ground truth, beside the paper's rule and a minimum number of points
	@$(BIN)/python -m benchmarks.accuracy $(ARGS)

bench-pipeline: $(BENCH_READY) ## cost of a frame, beside Open3D, OctoMap and Embree on the same frames
	@$(BIN)/python -m benchmarks.pipeline $(ARGS)

bench-master: $(READY) ## load test of one master, beside a bare route of FastAPI
	@$(BIN)/python -m benchmarks.master $(ARGS)

bench-scale: $(READY) ## one master with an increasing number of units: docs/scaling.md
	@$(BIN)/python -m benchmarks.scale $(ARGS)

bench-latency: $(READY) ## latency from the capture of a frame to a robot's map, by stage
	@$(BIN)/python -m benchmarks.latency $(ARGS)

soak: $(READY) ## random faults for MINUTES (30): no wrong answer, no growth; SEED=n repeats a run
	@$(BIN)/python -m qualification.soak --minutes $(MINUTES) $(if $(SEED),--seed $(SEED)) $(ARGS)

bench-board: $(READY) ## accuracy of a camera pose from a calibration board, by distance
	@$(BIN)/python -m benchmarks.board $(ARGS)

bench-pose-monitor: $(READY) ## time until a knocked or covered camera is reported, and rate of false alarms
	@$(BIN)/python -m benchmarks.pose_monitor $(ARGS)

bench-paper: $(BENCH_READY) ## the paper's experiment: one to four cameras, distributed against centralised and OctoMap
	@$(BIN)/python -m benchmarks.paper $(ARGS)

viewer-test: $(READY) ## the operator's window in a real browser, and the cost of viewers to the units
	@$(BIN)/python -m qualification.window $(ARGS)

rehearsal: $(READY) ## a master and three units as machines that boot the files of a board (root, systemd-nspawn)
	@$(BIN)/python -m qualification.boot $(ARGS)

image-test: $(READY) ## two arm64 boards boot from one image, find a master and report to it (root, QEMU)
	@$(BIN)/python -m qualification.image $(ARGS)

fresh-machine: $(READY) ## demo and test on Debians that have only Python, its venv and make (root, mmdebstrap)
	@$(BIN)/python -m qualification.fresh_machine $(ARGS)

pictures: $(READY) ## the pictures of the README and of docs/architecture.md, made again
	@$(BIN)/python -m simulation.demo.picture assets/pictures/demo.png
	@$(BIN)/python -m simulation.demo.window_pictures assets/pictures
	@$(BIN)/python scripts/draw_architecture.py

docs: $(DOCS_READY) ## the documentation as a site in out/site; fails on a dead link or a missing docstring
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build -q --strict --clean
	@echo "out/site/index.html can be opened; for its search: $(BIN)/python -m http.server -d out/site"

test: $(READY) lint ## lint, then all tests except the slow ones; SLOW=1 includes them
	@failed=0; \
	$(PYTEST) -n $(WORKERS) -m "not alone$(if $(SLOW),, and not slow)" $(ARGS) || [ $$? -eq $(NO_TESTS) ] || failed=1; \
	$(PYTEST) -m "alone$(if $(SLOW),, and not slow)" $(ARGS) || [ $$? -eq $(NO_TESTS) ] || failed=1; \
	exit $$failed

lint: $(READY) ## ruff, and mypy for this Python and for 3.10
	@failed=0; \
	$(BIN)/ruff check -q . || failed=1; \
	$(BIN)/ruff format -q --check . || failed=1; \
	$(if $(TYPED),$(BIN)/mypy --no-error-summary $(TYPED) $(SCRIPTS) || failed=1; \
	$(BIN)/mypy --no-error-summary --config-file scripts/mypy-3.10.ini $(TYPED) || failed=1;) \
	exit $$failed

clean: ## removes .venv and all caches, but keeps the results in out/
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): pyproject.toml constraints.txt
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { python=$$(scripts/find-python) && \
	    echo "making $(VENV) with $$($$python --version) (some 1 GB, a minute or two)" && \
	    $$python -m venv --clear $(VENV); }
	@$(BIN)/python -m pip install -q -c constraints.txt pip
	@$(BIN)/python -m pip install -q -c constraints.txt --build-constraint constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

# Peers of the benchmarks: large, so only the targets that need them install them.
$(BENCH_READY): $(READY)
	@echo "adding the peers of the benchmarks to $(VENV) (some 2 GB)"
	@$(BIN)/python -m pip install -q -c constraints.txt --build-constraint constraints.txt -e '.[$(EXTRAS),bench]'
	@touch $@

# What makes the site of the documentation.
$(DOCS_READY): $(READY)
	@$(BIN)/python -m pip install -q -c constraints.txt --build-constraint constraints.txt -e '.[$(EXTRAS),docs]'
	@touch $@
