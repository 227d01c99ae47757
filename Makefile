# make setup | demo | train | test | test-fast | lint | docs      overrides and options go in ARGS, e.g. make train ARGS="seed=3"
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python
IN_PARALLEL := -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

.PHONY: setup demo train test test-fast lint docs
setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml packages/lidar/pyproject.toml packages/robot/pyproject.toml requirements.txt requirements-no-deps.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python >= 3.11 is needed, $$($(PYTHON) -V) was found; name another: $(strip make $(MAKECMDGOALS)) PYTHON=python3.12" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --upgrade pip
	$(RUN) -m pip install --quiet --no-compile --requirement requirements.txt
	$(RUN) -m pip install --quiet --no-compile --no-deps --requirement requirements-no-deps.txt
	$(RUN) -m pip install --quiet --no-deps --editable packages/lidar --editable packages/robot --editable .
	@touch $@

demo: setup
	$(RUN) -m omniperception demo $(ARGS)

train: setup
	$(RUN) train.py experiment=quickstart $(ARGS)

test: setup
	$(RUN) -m pytest -m "not slow" $(IN_PARALLEL) $(ARGS)

test-fast: setup
	$(RUN) -m pytest -m "not slow and not integration" $(IN_PARALLEL) $(ARGS)

lint: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(VENV)/bin/lint-imports --no-cache

docs: setup
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict --quiet
