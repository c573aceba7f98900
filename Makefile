# `make help` lists the targets. Everything runs in .venv, which is set up once and again only when the lock changes.
PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3.11)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup reproduce test test-fast test-slow test-report test-slurm ci-short batch timings lint format notebooks report reference evaluate-reference bench bench-peers clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 22

$(STAMP): requirements.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "needs Python 3.11 on Linux (PyBullet has no later wheels); set PYTHON=/path/to/python3.11"; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11) or not sys.platform.startswith("linux"))' \
		|| { echo "needs Python 3.11 on Linux (PyBullet has no later wheels); $(PYTHON) is something else"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

setup: $(STAMP)  ## make .venv with the exact versions of requirements.lock

reproduce: $(STAMP)  ## the main job in its short form: train, run the notebooks, build results/report/index.html
	$(BIN)/reproduce notebooks --preset smoke
	$(BIN)/reproduce claims --json results/report/claims.json
	@echo "report: results/report/index.html"

test: lint  ## lint, types and tests (about 6 minutes on 2 idle cores)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal --durations=20 -m "not slow and not browser"

test-fast: $(STAMP)  ## the tests that start no process, train nothing and take no second (a minute on 2 idle cores)
	$(BIN)/python -m pytest -q -n 2 --dist worksteal -m "not slow and not browser and not process"

test-slow: $(STAMP)  ## learning tests, kills, the soak and long physics runs
	$(BIN)/python -m pytest -q -m slow

test-report: $(STAMP)  ## open every page of results/report in headless Chromium, which Debian's package chromium brings
	test -f results/report/index.html || $(BIN)/reproduce notebooks --preset smoke
	$(BIN)/python -m pytest -q -m browser

test-slurm: $(STAMP)  ## run the smoke batch under a real Slurm on this machine (Debian 12, as root) and compare it
	$(BIN)/python tests/slurm_batch.py

lint: $(STAMP)  ## what pre-commit runs
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

format: $(STAMP)  ## format the code
	$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

ci-short: $(STAMP)  ## every notebook in its shortest form, and the report without replays (under 4 minutes on 2 idle cores)
	$(BIN)/reproduce notebooks --preset smoke --no-report -p tests=2 -p steps=512
	$(BIN)/reproduce report --no-replays

batch: $(STAMP)  ## everything as a workflow: all methods, training, tests, notebooks, report (PRESET=laptop, SEEDS=0)
	$(BIN)/reproduce batch --preset $(or $(PRESET),laptop) --methods all --seeds $(or $(SEEDS),0)

timings: $(STAMP)  ## time the smoke batch, one step after the other, for the README's table of commands
	rm -rf results/scratch/timings
	$(BIN)/reproduce batch --preset smoke --slots 1 --out results/scratch/timings
	cp results/scratch/timings/timings.csv results/timings.csv
	$(BIN)/python -m reproduce.report.pages

notebooks: $(STAMP)  ## run the notebooks with the laptop preset
	$(BIN)/reproduce notebooks --preset laptop

reference: $(STAMP)  ## train the HRL-DCS reference run again (about an hour) into results/scratch
	$(BIN)/reproduce train hrl_dcs --preset laptop --seed 0 --out results/scratch/hrl_dcs

evaluate-reference: $(STAMP)  ## test the reference policies on 1000 scenes each and rewrite tables and claims
	$(BIN)/reproduce evaluate-reference
	$(BIN)/python -m reproduce.report.pages

bench: $(STAMP)  ## measure speed
	$(BIN)/reproduce bench

bench-peers: $(STAMP)  ## the same beside panda-gym, which this installs into .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation -c requirements.lock -e '.[peers]'
	$(BIN)/reproduce bench

clean:  ## remove caches and built pages; never results
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache results/report results/notebooks results/scratch
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
