# Needs python3 (3.10 or newer), pip, make and git; all else goes into .venv. `make` alone lists the targets.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
LEAN   := $(VENV)/.demo
BROWSER := $(VENV)/.browser
NEEDED := robots,validate
EXTRAS := robots,validate,peers,sweep,cluster,mcap,live,docs,notebooks,dev
ARGS   ?=
# Without its bytecode a process needs 3 s in place of 2 s to import the package; tests start a hundred of them.
unexport PYTHONDONTWRITEBYTECODE
STUDY  := PYTHONPATH=tests $(BIN)/python -m
# ARGS, where their first word is a name; else a default name before them
named = $(if $(filter-out -%,$(firstword $(ARGS))),,$(1)) $(ARGS)

.DEFAULT_GOAL := help
.PHONY: help venv demo test slow lint types format bench attack robots reproduce figures docs notebooks clean distclean

help: ## list the targets
	@echo "make <target>"
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/  \1|\2/p' $(firstword $(MAKEFILE_LIST)) | awk -F'|' '{printf "%-12s %s\n", $$1, $$2}'
	@echo "Options: ARGS='...' for test, slow, demo, bench, attack and reproduce; PYTHON=... for the interpreter that makes .venv"

venv: $(STAMP) ## make .venv with this project and what it needs

# Where python3 comes without ensurepip, the pip beside it fills a venv made without one.
$(LEAN): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "$(PYTHON) is older than 3.10; name a newer one: make PYTHON=python3.12 ..."; exit 1; }
	@if $(BIN)/python -m pip --version >/dev/null 2>&1; then \
		echo "== $(VENV) is there, and pyproject.toml is newer"; \
	else \
		echo "== making $(VENV) with $$($(PYTHON) --version)"; \
		rm -rf $(VENV); \
		if $(PYTHON) -c 'import ensurepip' 2>/dev/null; then \
			$(PYTHON) -m venv $(VENV); \
		else \
			$(PYTHON) -m venv --without-pip $(VENV) && $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; \
		fi; \
	fi
	@echo "== installing impactopt and what the demo needs into $(VENV): some 270 MB to download"
	@$(BIN)/python -m pip install --disable-pip-version-check --editable '.[$(NEEDED)]'
	@touch $@

# Tests, documents and benches need more than the demo.
$(STAMP): pyproject.toml $(LEAN)
	@echo "== installing what all else needs into $(VENV): some 280 MB to download"
	@$(BIN)/python -m pip install --disable-pip-version-check --editable '.[$(EXTRAS)]'
	@touch $@
	@echo "== $(VENV) is ready"

demo: $(LEAN) ## plan a TALOS punch, replay it in full dynamics, put pictures and numbers in results/punch
	@echo "== planning a punch (the first run compiles the robot's functions)"
	@$(BIN)/impactopt solve problems/punch.toml --out results/punch --baseline --workers 2 $(ARGS)

# Only tests open pages in a browser.
$(BROWSER): $(STAMP)
	@echo "== installing a browser for the tests of pages: some 180 MB"
	@$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable '.[browser]'
	@touch $@

test: $(STAMP) $(BROWSER) ## run the quick tests, nine in ten (ARGS='-k robot' for some of them)
	@echo "== running the quick tests (the first run compiles functions); \`make slow\` runs the others"
	@$(BIN)/python -m pytest -n auto --dist loadfile -m 'not slow' $(ARGS)

slow: $(STAMP) $(BROWSER) ## run the slow tests: whole plans in both engines, drafts, clusters, pages
	@echo "== running the slow tests"
	@$(BIN)/python -m pytest -n auto --dist loadfile -m slow $(ARGS)

lint: $(STAMP) ## check style with ruff
	@echo "== ruff"
	@$(BIN)/ruff check .

types: $(STAMP) ## check types with mypy
	@echo "== mypy"
	@$(BIN)/mypy

format: $(STAMP) ## rewrite the sources in the project's style
	@$(BIN)/ruff check --fix . && $(BIN)/ruff format .

bench: $(STAMP) ## run every benchmark, about an hour (ARGS=NAME for one); tables, JSON and pictures in results/bench
	@$(STUDY) benchmarks $(call named,all) --out results/bench

attack: $(STAMP) ## attack it at length: files, URDFs, commands, calls, collisions (ARGS='--seed 7'); faults in results/attack
	@$(STUDY) benchmarks attack --out results/attack $(ARGS)

robots: $(STAMP) ## draft, plan and replay the arms and bipeds of example-robot-data, half an hour (ARGS='--resume' goes on); results/robots
	@$(STUDY) benchmarks robots --out results/bench $(ARGS)

reproduce: $(STAMP) ## the paper's tables and figures beside ours, some minutes (ARGS=fig7 for one); results/reproduce
	@$(STUDY) benchmarks.paper $(call named,all) --out results/reproduce

figures: $(STAMP) ## make the figures of docs/ anew (ARGS='strobe fig7' for some; the benchmarks' only by name)
	@$(STUDY) benchmarks.figures $(ARGS)

docs: $(STAMP) ## build the documentation, needs no internet: build/docs/index.html
	@$(BIN)/python -m sphinx -W --keep-going -q docs build/docs
	@echo "== open build/docs/index.html"

notebooks: $(STAMP) ## execute the notebooks, some minutes; with their outputs in results/notebooks (ARGS=notebooks/3_*.ipynb for one)
	@mkdir -p results/notebooks
	@echo "== executing notebooks, two at a time"
	@# The last notebooks take longest, so they come first.
	@printf '%s\n' $(or $(ARGS),notebooks/*.ipynb) | sort -rV | xargs -P 2 -I FILE sh -c ' \
		log=results/notebooks/$$(basename FILE .ipynb).log; \
		if $(BIN)/jupyter execute --timeout=600 --output=../results/notebooks/{notebook_name} FILE >$$log 2>&1; \
		then echo "== FILE"; \
		else cat $$log; echo "== FILE failed"; exit 1; fi'

clean: ## remove results and caches of the tools; .venv and compiled functions stay
	rm -rf results build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean ## clean, and remove .venv too
	rm -rf $(VENV)
