# setup: environment in .venv · train: train a unit · study: comparison of the paper · test: lints, types, imports, tests
# docs: documentation site in outputs/docs (INTERSPHINX=1 adds links to other projects)
# slow: long tests (with Ray and Optuna if installed) · bench: benchmarks · soak: fault injection · fuzz: fuzzing of parsers
VENV ?= .venv
PYTHON ?= python3
RUN := $(VENV)/bin/python
ARGS ?= +experiment=chair_unet

.PHONY: setup train study test lint pytest docs slow bench soak fuzz

setup: $(VENV)/.made

$(VENV)/.made: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; assert sys.version_info >= (3, 11), "Python 3.11 or later is needed"'
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --disable-pip-version-check -r requirements.lock
	$(RUN) -m pip install --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

train: setup
	$(RUN) -m imagination.train $(ARGS)

study: setup
	$(RUN) -m imagination.study $(if $(filter command line,$(origin ARGS)),$(ARGS))

test: setup
	$(MAKE) --no-print-directory --jobs 2 lint pytest

lint:
	$(RUN) -m ruff check .
	$(RUN) -m mypy
	$(VENV)/bin/lint-imports --no-logo

pytest:
	$(RUN) -m pytest -n 2 --dist worksteal

docs: setup
	$(RUN) -m sphinx --fail-on-warning --keep-going --quiet -j 2 docs outputs/docs

slow: setup
	$(RUN) -m pytest -m slow

bench: setup
	$(RUN) -m tests.benchmarks

soak: setup
	$(RUN) -m tests.robustness.soak

fuzz: setup
	$(RUN) -m tests.robustness.fuzz
