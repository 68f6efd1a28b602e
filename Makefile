# Every target first makes .venv with the versions pinned in requirements.txt (again when pins change).
# `make` alone lists the targets.

PYTHON ?= python3
VENV   := .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.made

PRESET     ?= tiny
DATA       ?=
INIT       ?= runs/stage1
STEPS      ?=
STOP_AFTER ?=
SAVE       ?=
BATCH      ?=
LABEL      ?= object
GOLDEN     ?= ../shared/golden
WORKERS    ?= 2

train-stage1: RUN ?= runs/stage1
train-stage2 probe: RUN ?= runs/stage2

ANYTOUCH := $(PY) -m anytouch_jax
PYTEST   := $(PY) -m pytest -n $(WORKERS) --dist loadfile
CHECKED  := src tests $(wildcard experiments)
OPTIONS   = --run $(RUN) --preset $(PRESET)$(if $(STEPS), --steps $(STEPS))$(if $(STOP_AFTER), --stop-after $(STOP_AFTER))$(if $(SAVE), --save-every $(SAVE))$(if $(BATCH), --batch $(BATCH))
need      = $(if $($(1)),,$(error `make $@` needs $(1)=, for example: make $@ $(2)))

.DEFAULT_GOAL := help
.PHONY: help setup train-stage1 train-stage2 probe parity test test-all lint format clean

help: ## list the targets
	@echo "make TARGET [NAME=value ...]"
	@echo
	@sed -n 's/^\([a-z0-9-]*\):[^#]*## /\1\t/p' Makefile | while IFS='	' read -r name text; do printf '  %-14s %s\n' "$$name" "$$text"; done
	@echo
	@echo "  DATA=a.parquet   manifest of frames, Parquet or CSV; several in quotes: DATA=\"a.parquet b.csv\""
	@echo "  RUN=folder       where the run is kept and resumed from (runs/stage1, runs/stage2)"
	@echo "  INIT=path        what stage 2 starts from: a stage-1 run or a weights file ($(INIT))"
	@echo "  PRESET=name      tiny, small, base or large ($(PRESET))"
	@echo "  STEPS=n  STOP_AFTER=n  SAVE=n  BATCH=n   whole schedule; end early; steps between checkpoints; samples a step"
	@echo "  LABEL=name       label column of probe ($(LABEL));  GOLDEN=folder  vectors of parity ($(GOLDEN))"

setup: $(STAMP) ## make .venv with the pinned versions

train-stage1: $(STAMP) ## masked and next-frame pre-training: DATA= [RUN= PRESET= STEPS= STOP_AFTER= SAVE=]
	$(call need,DATA,DATA=touch.parquet)$(ANYTOUCH) train --stage 1 --data $(DATA) $(OPTIONS)

train-stage2: $(STAMP) ## alignment and matching on top of INIT: DATA= [INIT= RUN= PRESET= STEPS= ...]
	$(call need,DATA,DATA=touch.parquet INIT=runs/stage1)$(ANYTOUCH) train --stage 2 --data $(DATA) $(OPTIONS) --init $(INIT)

probe: $(STAMP) ## linear and kNN probes of a run on a label column: DATA= LABEL= [RUN=]
	$(call need,DATA,DATA=touch.parquet LABEL=object)$(ANYTOUCH) probe --run $(RUN) --data $(DATA) --label $(LABEL)

parity: $(STAMP) ## compare with recorded outputs of the authors' code: [GOLDEN=]
	$(ANYTOUCH) parity $(GOLDEN)

test: $(STAMP) ## the quick tests, some minutes on two cores
	$(PYTEST) -m "not slow"

test-all: $(STAMP) ## every test
	$(PYTEST)

lint: $(STAMP) ## ruff (rules and format) and mypy
	$(PY) -m ruff check $(CHECKED)
	$(PY) -m ruff format --check $(CHECKED)
	$(PY) -m mypy

format: $(STAMP) ## rewrite the sources in the project's format
	$(PY) -m ruff check --fix $(CHECKED)
	$(PY) -m ruff format $(CHECKED)

clean: ## remove .venv, builds and caches; runs stay
	rm -rf $(VENV) build dist src/*.egg-info .pytest_cache .mypy_cache .ruff_cache
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "This project needs Python 3.11 or newer; name one with PYTHON=, for example: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(PY) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@
