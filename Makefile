# SPDX-License-Identifier: Apache-2.0
# Every target makes .venv by itself, from constraints.txt, when it is missing or older than its list of packages.

SHELL := /bin/sh
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo real sweeps right-time source-faults faults plug-and-play bench bench-accuracy bench-pipeline bench-board bench-master bench-scale bench-latency soak bench-pose-monitor bench-paper viewer-test rehearsal image-test fresh-machine pictures test lint clean

ARGS ?=
MINUTES ?= 30
EXTRAS := edge,master,realsense,sim,dev
VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest -q
# Of the tests that need no quiet machine, as many at once as there are cores; the others one by one.
WORKERS ?= logical
# pytest's exit code where ARGS names none of either kind.
NO_TESTS := 5
READY := $(VENV)/ready
BENCH_READY := $(VENV)/ready-bench
TYPED := $(patsubst %/,%,$(dir $(wildcard $(addsuffix /__init__.py,shared geometry edge_unit master_server simulation benchmarks qualification))))

# Recorded data, where it lies beside the checkout.
ifneq ($(wildcard ../shared/data),)
export CELLWATCH_DATA ?= $(abspath ../shared/data)
endif

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1 \t\2/p' Makefile | expand -t 24
	@echo 'Arguments go through ARGS: make demo ARGS="--seconds 20". Another Python: make PYTHON=python3.12 ...'

demo: $(READY) ## a simulated cell with a moving robot, people and many cameras
	@$(BIN)/python -m simulation.demo $(ARGS)

real: $(READY) ## the filter on recorded frames of a real cell (CELLWATCH_DATA names where they lie)
	@$(BIN)/python -m benchmarks.real $(ARGS)

sweeps: $(READY) ## how thin, how small, how silent: the filter before simulated cameras
	@$(BIN)/python -m benchmarks.sweeps $(ARGS)

right-time: $(READY) ## joints that come late, jittering, seldom: the robot filtered where it was
	@$(BIN)/python -m benchmarks.right_time $(ARGS)

source-faults: $(READY) ## a RealSense camera that hangs, dies and is unplugged: how long until frames flow again
	@$(BIN)/python -m qualification.source_faults $(ARGS)

faults: $(READY) ## units, master, networks, clocks and disks that fail: what the map says meanwhile
	@$(BIN)/python -m qualification.faults $(ARGS)

plug-and-play: $(READY) ## four units that know nothing but a token, and what people do to them later
	@$(BIN)/python -m qualification.plug_and_play $(ARGS)

bench: $(BENCH_READY) ## what Cellwatch claims, measured anew in some 20 minutes: out/REPORT.md
	@$(BIN)/python -m benchmarks.bench $(ARGS)

bench-accuracy: $(READY) ## curves against ground truth, beside the paper's rule and a least number of points
	@$(BIN)/python -m benchmarks.accuracy $(ARGS)

bench-pipeline: $(BENCH_READY) ## what a frame costs, beside Open3D, OctoMap and Embree on the same frames
	@$(BIN)/python -m benchmarks.pipeline $(ARGS)

bench-master: $(READY) ## how many units one master bears, beside a bare route of FastAPI
	@$(BIN)/python -m benchmarks.master $(ARGS)

bench-scale: $(READY) ## one master and more and more units, until it bends: docs/scaling.md
	@$(BIN)/python -m benchmarks.scale $(ARGS)

bench-latency: $(READY) ## where the milliseconds go from the capture of a frame to a robot's map
	@$(BIN)/python -m benchmarks.latency $(ARGS)

soak: $(READY) ## all sorts of faults at once for MINUTES (30): no answer wrong, nothing grows; SEED=n for the same again
	@$(BIN)/python -m qualification.soak --minutes $(MINUTES) $(if $(SEED),--seed $(SEED)) $(ARGS)

bench-board: $(READY) ## how well a camera's pose is found by a calibration board, by distance
	@$(BIN)/python -m benchmarks.board $(ARGS)

bench-pose-monitor: $(READY) ## how soon a knocked or covered camera is told, and how often one is wrongly suspected
	@$(BIN)/python -m benchmarks.pose_monitor $(ARGS)

bench-paper: $(BENCH_READY) ## the paper's experiment: one to four cameras, distributed against centralised and OctoMap
	@$(BIN)/python -m benchmarks.paper $(ARGS)

viewer-test: $(READY) ## the operator's window in a real browser, and what those who look cost the units
	@$(BIN)/python -m qualification.window $(ARGS)

rehearsal: $(READY) ## a master and three units as machines that boot from what a board is given (root, systemd-nspawn)
	@$(BIN)/python -m qualification.boot $(ARGS)

image-test: $(READY) ## two arm64 boards boot from one image, find a master and report to it (root, QEMU)
	@$(BIN)/python -m qualification.image $(ARGS)

fresh-machine: $(READY) ## demo and test on Debians that have only Python, its venv and make (root, mmdebstrap)
	@$(BIN)/python -m qualification.fresh_machine $(ARGS)

pictures: $(READY) ## the pictures of the README and of docs/architecture.md, drawn anew
	@$(BIN)/python -m simulation.demo.picture assets/pictures/demo.png
	@$(BIN)/python -m simulation.demo.window_pictures assets/pictures
	@$(BIN)/python scripts/draw_architecture.py

test: $(READY) lint ## lint, then all tests but the slow ones; with SLOW=1 these too
	@failed=0; \
	$(PYTEST) -n $(WORKERS) -m "not alone$(if $(SLOW),, and not slow)" $(ARGS) || [ $$? -eq $(NO_TESTS) ] || failed=1; \
	$(PYTEST) -m "alone$(if $(SLOW),, and not slow)" $(ARGS) || [ $$? -eq $(NO_TESTS) ] || failed=1; \
	exit $$failed

lint: $(READY) ## ruff, and mypy for this Python and for 3.10
	@failed=0; \
	$(BIN)/ruff check -q . || failed=1; \
	$(BIN)/ruff format -q --check . || failed=1; \
	$(if $(TYPED),$(BIN)/mypy --no-error-summary $(TYPED) || failed=1; \
	$(BIN)/mypy --no-error-summary --config-file scripts/mypy-3.10.ini $(TYPED) || failed=1;) \
	exit $$failed

clean: ## takes out .venv and all caches, and leaves the results in out/
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): pyproject.toml constraints.txt
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { python=$$(scripts/find-python) && \
	    echo "making $(VENV) with $$($$python --version) (some 1 GB, a minute or two)" && \
	    $$python -m venv --clear $(VENV); }
	@$(BIN)/python -m pip install -q -c constraints.txt pip
	@$(BIN)/python -m pip install -q -c constraints.txt --build-constraint constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

# Peers to measure against: large, so only the targets that need them ask for them.
$(BENCH_READY): $(READY)
	@echo "adding the peers of the benchmarks to $(VENV) (some 2 GB)"
	@$(BIN)/python -m pip install -q -c constraints.txt --build-constraint constraints.txt -e '.[$(EXTRAS),bench]'
	@touch $@
