# `make example` and `make test` do everything on a fresh machine; each target sets up .venv first.
PYTHON ?= python3
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
OUT ?= runs/$(notdir $(basename $(WORKFLOW)))

.PHONY: help example run test fuzz lint bench bench-poses bench-logs pictures results clean
help:
	@echo "make example                 the built-in flight, from photos to scored points, in runs/example"
	@echo "make run WORKFLOW=file.toml  a flight of yours, in runs/NAME (OUT=folder to choose)"
	@echo "make test | lint | bench     the tests, the checks of the code, the timings as ratios"
	@echo "make bench-poses             refinement on planted errors, redraws, real photo sets, thousands of frames"
	@echo "make bench-logs              every kind of log against the stills, and big logs' speed and memory"
	@echo "make fuzz                    10,000 damaged copies of a real file for every reader"
	@echo "make pictures                the pictures of the README, from runs/example"
	@echo "make results                 the README's tables and pictures, from the example flight and the room"
	@echo "make clean                   removes runs/, example/, room/ and .venv"

# Dependencies are installed only when what names them changes; sources are used in place.
$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

example/workflow.toml: | $(READY)
	rm -rf example
	$(BIN)/epitransfer example example

example: example/workflow.toml
	$(MAKE) --no-print-directory run WORKFLOW=example/workflow.toml OUT=runs/example
	$(BIN)/python benchmarks/example_truth.py example runs/example

ifdef WORKFLOW
include workflows/rules.mk
run: $(RECORDS)
	@$(BIN)/epitransfer run $(OUT)/workflow.toml --out $(OUT)
else
run:
	@echo "usage: make run WORKFLOW=workflows/NAME.toml [OUT=folder]" >&2; exit 2
endif

test: $(READY)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

fuzz: $(READY)
	EPITRANSFER_FUZZ=10000 $(BIN)/python -m pytest -n $(JOBS) -k fuzz

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The networks' rows need weights: $EPITRANSFER_WEIGHTS, or `epitransfer models fetch`; real photo sets are looked for in
# $EPITRANSFER_SHARED or ../shared. Some fifteen minutes on two cores; without either, six.
bench: $(READY) example/workflow.toml
	$(BIN)/python benchmarks/kernels.py
	$(BIN)/python benchmarks/whole_path.py example
	$(BIN)/python benchmarks/sfm.py example
	$(BIN)/python benchmarks/matchers.py example
	$(BIN)/python benchmarks/vga_path.py example
	$(BIN)/python benchmarks/raft_depth.py example

# What refinement does where the truth is known, and to real sets; an hour on two cores.
bench-poses: $(READY) example
	rm -rf runs/planted runs/real
	$(BIN)/python benchmarks/refined.py example runs/planted
	$(BIN)/python benchmarks/shared_errors.py example runs/example
	$(BIN)/python benchmarks/calibration.py example runs/example
	$(BIN)/python benchmarks/calibration_points.py example runs/example
	$(BIN)/python benchmarks/real_refined.py runs/real
	$(BIN)/python benchmarks/big_flight.py

# The flight from logs against the flight from stills, and logs of 1 and 5 GB; some ten minutes and 6 GB of disk.
bench-logs: $(READY) example
	$(BIN)/python benchmarks/logs_truth.py example runs/example runs/logs
	$(BIN)/python benchmarks/big_ingest.py runs/big

pictures: $(READY)
	$(BIN)/python docs/pictures.py runs/example docs

room/workflow.toml: | $(READY)
	rm -rf room
	$(BIN)/epitransfer example room --indoor

# What the README says of accuracy, from the flight and the room; the page is looked at where there is a chromium.
results: $(READY) example room/workflow.toml
	$(MAKE) --no-print-directory run WORKFLOW=room/workflow.toml OUT=runs/room
	$(BIN)/python docs/results.py README.md "Example flight=runs/example" "Room with motion capture=runs/room"
	$(BIN)/python docs/pictures.py runs/example docs
	! command -v chromium >/dev/null || $(BIN)/python benchmarks/report_browser.py runs/example --pictures runs/example-report

clean:
	rm -rf runs example room $(VENV)
