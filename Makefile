# Every target first makes .venv with the versions pinned in requirements.txt (again when pins change).
# `make` alone lists the targets.

PYTHON ?= python3
# Large pages of memory: a million page faults a step less.
export GLIBC_TUNABLES ?= glibc.malloc.hugetlb=1
VENV   := .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.made
TORCH  := .venv-torch
DOCS   := .venv-docs
# Another jax, and an interpreter that it supports, for test-jax.
JAX       ?= 0.12.0.1
NEWPYTHON ?= python3.13
NEWER     := .venv-jax-$(JAX)

PRESET     ?= tiny
SCENES     ?= data/scenes
DATA       ?= $(SCENES)/manifest.parquet
# Training draws simulated touches that never repeat, unless data are given.
TRAINED_ON  = $(if $(findstring file,$(origin DATA)),simulated,$(DATA))
INIT       ?= runs/stage1
STEPS      ?=
STOP_AFTER ?=
SAVE       ?=
BATCH      ?=
ARGS       ?=
LABEL      ?= material
GOLDEN     ?= tests/parity/golden
WORKERS    ?= 2
CORPUS     ?= data/corpus
REAL       ?=
TOUCH      ?=
WEIGHTS    ?= runs/anytouch-tiny
MINUTES    ?= 12
ENCODERS   ?=

DEMO         ?= runs/demo
DEMO_MINUTES ?= 2

train-stage1: RUN ?= runs/stage1
train-stage2 probe: RUN ?= runs/stage2

ANYTOUCH := $(PY) -m anytouch_jax
PYTEST   := $(PY) -m pytest -n $(WORKERS) --dist loadfile
CHECKED  := src tests docs $(wildcard experiments integrations)
OPTIONS   = --run $(RUN) --preset $(PRESET)$(if $(STEPS), --steps $(STEPS))$(if $(STOP_AFTER), --stop-after $(STOP_AFTER))$(if $(SAVE), --save-every $(SAVE))$(if $(BATCH), --batch $(BATCH))
STUDIED   = $(if $(RUNS), --runs $(RUNS))$(if $(STUDY), --study $(STUDY))$(if $(filter-out 0,$(QUICK)), --quick)$(if $(OUT), --out $(OUT))
TOUCHES  := --touches 850 --sensors gelsight_mini digit gelsight gelslim duragel 9dtact --seed 41 --depth 0.15 1.0 --frames 6 --objects 480 --size 128 --vision 0.4 --text 0.7
# Simulated data are made when they are what is asked for and are not there.
scenes    = $(if $(filter $(SCENES)/manifest.parquet,$(DATA)),$(DATA))

.DEFAULT_GOAL := help
.PHONY: help setup demo simulate train-stage1 train-stage2 probe parity test test-all test-jax lint format bench bench-torch bench-gpu compare pouring translation experiments results notebooks corpus weights figures release-check docs clean

help: ## list the targets
	@echo "make TARGET [NAME=value ...]"
	@echo
	@sed -n 's/^\([a-z0-9-]*\):[^#]*## /\1\t/p' Makefile | while IFS='	' read -r name text; do printf '  %-14s %s\n' "$$name" "$$text"; done
	@echo
	@echo "  DATA=a.parquet   manifest of frames, Parquet or CSV; several in quotes: DATA=\"a.parquet b.csv\""
	@echo "                   a path with spaces in quotes of its own: DATA=\"'my folder/a.parquet' b.csv\""
	@echo "                   (default: training simulates touches that never repeat; probe makes scenes in $(SCENES))"
	@echo "  RUN=folder       where the run is kept and resumed from (runs/stage1, runs/stage2)"
	@echo "  INIT=path        what stage 2 starts from: a stage-1 run or a weights file ($(INIT))"
	@echo "  PRESET=name      tiny, small, base or large ($(PRESET))"
	@echo "  STEPS=n  STOP_AFTER=n  SAVE=n  BATCH=n   whole schedule; end early; steps between checkpoints; samples a step"
	@echo "  ARGS=\"--recipe release\"                 any other option of anytouch train"
	@echo "  LABEL=name       label column of probe ($(LABEL));  GOLDEN=folder  vectors of parity ($(GOLDEN))"

setup: $(STAMP) ## make .venv with the pinned versions

demo: $(STAMP) ## a sensor that the encoder has never met learns to name shapes: a page within a minute, the whole below ten: [DEMO= DEMO_MINUTES=2, of each of two trainings]
	TF_CPP_MIN_LOG_LEVEL=3 $(PY) -m experiments.demo.run --out $(DEMO) --minutes $(DEMO_MINUTES)

simulate: $(STAMP) ## touch scenes by several sensors: [SCENES=]
	$(ANYTOUCH) data simulate --out $(SCENES)

train-stage1: $(STAMP) ## masked and next-frame pre-training: [DATA=simulated RUN= PRESET= STEPS= STOP_AFTER= SAVE= ARGS=]
	$(ANYTOUCH) train --stage 1 --data $(TRAINED_ON) $(OPTIONS) $(ARGS)

train-stage2: $(STAMP) ## alignment and matching on top of INIT: [DATA=simulated INIT= RUN= PRESET= STEPS= ...]
	$(ANYTOUCH) train --stage 2 --data $(TRAINED_ON) $(OPTIONS) --init $(INIT) $(ARGS)

probe: $(STAMP) $(scenes) ## linear and kNN probes of a run on a label column: [DATA= LABEL= RUN=]
	$(ANYTOUCH) probe label --model $(RUN) --data $(DATA) --label $(LABEL)

parity: $(STAMP) ## compare with recorded outputs of the authors' code: [GOLDEN=]
	$(PY) -m tests.parity.run $(GOLDEN)

test: $(STAMP) ## the quick tests, some minutes on two cores
	$(PYTEST) -m "not slow"

# The packages of the bucket test ask for other versions than the pinned ones, so they stand apart.
test-all: $(STAMP) ## every test
	-$(PY) -m pip install -q playwright
	-$(PY) -m pip install -q --target $(VENV)/buckets "moto[server]" s3fs
	-npm install --silent --no-save --no-audit --no-fund --prefix $(VENV) axe-core@4
	PYTHONPATH=$(CURDIR)/$(VENV)/buckets $(PYTEST)
	$(if $(shell $(NEWPYTHON) -c "print(1)" 2>/dev/null),$(MAKE) test-jax)

test-jax: $(NEWER)/.made ## tests of what is computed, under another jax in its own environment: [JAX=0.12.0.1 NEWPYTHON=python3.13]
	$(NEWER)/bin/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow" tests/ops tests/nn tests/train tests/parity tests/test_objectives.py

lint: $(STAMP) ## ruff (rules and format), mypy, the table of imports, and a report of sizes
	$(PY) -m ruff check $(CHECKED)
	$(PY) -m ruff format --check $(CHECKED)
	$(PY) -m mypy
	$(PY) -m pytest tests/laws/test_architecture.py
	@find src experiments tests -name '*.py' | cut -d/ -f1 | sort | uniq -c | while read files room; do \
		echo "$$room: $$files files, $$(find $$room -name '*.py' -exec cat {} + | grep -c .) lines"; done

format: $(STAMP) ## rewrite the sources in the project's format
	$(PY) -m ruff check --fix $(CHECKED)
	$(PY) -m ruff format $(CHECKED)

bench: $(STAMP) ## speed against error: [PRESET= BATCH= OUT= WHAT="stage1 embed ..."]; quiet the machine first
	$(PY) -m experiments.benchmarks.run $(WHAT) --preset $(PRESET)$(if $(BATCH), --batch $(BATCH))$(if $(OUT), --out $(OUT))

bench-torch: $(TORCH)/.made
bench-torch: $(STAMP) ## next to PyTorch, in a separate venv: [PRESET= BATCH= OUT= WHAT=]
	$(PY) -m experiments.benchmarks.pytorch.run $(WHAT) --torch $(TORCH)/bin/python --preset $(PRESET)$(if $(BATCH), --batch $(BATCH))$(if $(OUT), --out $(OUT))

bench-gpu: ## simulation, tiny and ViT-L on an accelerator in four minutes: PYTHON= with jax, flax, optax, numpy [OUT=]
	$(PYTHON) -m experiments.benchmarks.gpu$(if $(OUT), --out $(OUT))

compare: $(STAMP) ## encoders of all families: what they cost, and what your files know: [ENCODERS="a=FILE b=FILE" DATA=manifest LABEL= OUT=runs/compare/compare.jsonl]
	$(PY) -m experiments.compare.run$(if $(ENCODERS), --encoders $(ENCODERS) --data $(DATA) --label $(LABEL))$(if $(OUT), --out $(OUT))

pouring: $(STAMP) ## pour beads by touch alone, as the paper's table: [RUNS="anytouch=path static=path t3=path" STUDY= QUICK=1 OUT=]
	$(PY) -m experiments.pouring.study$(STUDIED)

translation: $(STAMP) ## one sensor's touch as another feels it, as the paper's table: [RUNS="anytouch=path t3=path" STUDY= STEPS1=3000 QUICK=1 OUT=]
	$(PY) -m experiments.translation.study$(STUDIED)$(if $(STEPS1), --steps1 $(STEPS1))

experiments: $(STAMP) ## the paper's tables on simulated touch, run by run: [QUICK=1 ONLY="q1 q2" RENDER=1 PLAN=1 WORK= OUT=]
	$(PY) -m experiments.tables.run$(if $(filter-out 0,$(QUICK)), --quick)$(if $(ONLY), --only $(ONLY))$(if $(filter-out 0,$(RENDER)), --render)$(if $(filter-out 0,$(PLAN)), --plan)$(if $(WORK), --work $(WORK))$(if $(OUT), --out $(OUT))

results: $(STAMP) ## the pages of experiments/results from their data alone: [OUT=]
	$(PY) -m experiments.pages $(OUT)

notebooks: $(STAMP) ## run the notebooks of experiments/notebooks again, in place: [PAGES="01 04" SCENES= for other scenes]
	$(if $(findstring file,$(origin SCENES)),,SCENES=$(abspath $(SCENES)) )$(PY) -m experiments.notebooks.execute $(PAGES)

corpus: $(STAMP) ## simulated touches on disk, of which the encoders are asked for look-alikes: [CORPUS=data/corpus]
	$(ANYTOUCH) data simulate --out $(CORPUS)/fine $(TOUCHES)
	$(ANYTOUCH) data simulate --out $(CORPUS)/coarse $(TOUCHES) --grade coarse --first 1700

weights: $(STAMP) ## train an encoder on endless touches for a time, and go on later: [MINUTES=12 REAL="a.csv b.csv" WEIGHTS=runs/anytouch-tiny]
	$(PY) -m experiments.encoders.train --minutes $(MINUTES) --real $(REAL) --out $(WEIGHTS)

figures: $(STAMP) ## after new weights: measure the shipped encoder, then the results, images, notebooks and pages that show it: [TOUCH=manifest of real touch]
	$(PY) -m experiments.real.run anytouch-tiny untrained:anytouch-tiny$(if $(TOUCH), --data $(TOUCH))
	$(PY) -m experiments.real.run anytouch-tiny --untouched median$(if $(TOUCH), --data $(TOUCH))
	$(PY) -m experiments.encoders.image docs/pictures/first_touch.png
	$(PY) -m experiments.encoders.animation docs/pictures/press.webp
	$(PY) -m experiments.pages
	$(PY) -m experiments.notebooks.execute 01 02 03
	WRITE_PAGES=1 $(PY) -m pytest tests/laws/test_pages_run.py

release-check: $(STAMP) ## build a release, install it into an empty environment, run the README there (network)
	$(PY) -m tests.release

docs: $(DOCS)/.made
docs: $(STAMP) ## the documentation site, in build/site, in a separate venv
	$(PY) -m docs.generate
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict

clean: ## remove .venv, builds and caches; runs stay
	rm -rf $(VENV) $(TORCH) $(DOCS) .venv-jax-* build dist src/*.egg-info .pytest_cache .mypy_cache .ruff_cache
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(SCENES)/manifest.parquet: | $(STAMP)
	$(ANYTOUCH) data simulate --out $(SCENES)

$(TORCH)/.made: experiments/benchmarks/pytorch/requirements.txt
	$(PYTHON) -m venv $(TORCH)
	@echo '*' > $(TORCH)/.gitignore
	$(TORCH)/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

$(DOCS)/.made: docs/requirements.txt
	$(PYTHON) -m venv $(DOCS)
	@echo '*' > $(DOCS)/.gitignore
	$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check -r $<
	@touch $@

$(NEWER)/.made: pyproject.toml
	$(NEWPYTHON) -m venv $(NEWER)
	@echo '*' > $(NEWER)/.gitignore
	$(NEWER)/bin/python -m pip install --quiet --disable-pip-version-check --editable ".[dev]" "jax==$(JAX)"
	@touch $@

$(STAMP): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "This project needs Python 3.11 or newer; name one with PYTHON=, for example: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --disable-pip-version-check -r requirements.txt
	$(PY) -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@
