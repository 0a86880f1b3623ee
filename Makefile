# make demo      steer the shipped prior and write runs/demo/report.html
# make test      run the tests; JOBS=8 for more processes, SEED=1 for one order, ARGS="-m 'not slow'" for pytest
# make test-gpu   run the tests of CUDA on a GPU; DEVICE=cpu tries them without one
# make test-docs  run the code of every page and notebook
# make lint      check style, formatting and types
# make docs      build the documentation into site/index.html
# make check     run all of this as continuous integration does
# make install   install SceneEnvs into .venv
# make install-dev   install the tools for tests, checks and documentation as well
# make clean     remove .venv and everything that was built
# make help      list the targets
# Each is the only command needed on a Linux machine with Python 3.11; the first one installs into .venv.

JOBS ?= 2
SEED ?= $(shell date +%s)
ENV := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE=
INSTALL := .venv/bin/python .ci/install.py -c constraints.txt

PYTEST := $(ENV) .venv/bin/python -m pytest --randomly-seed=$(SEED) -n $(JOBS) --dist worksteal
DEVICE ?= cuda
PAGES := tests/docs/test_pages.py tests/integration/test_notebooks.py

.PHONY: demo test test-gpu test-docs lint docs check install install-dev clean help

help:
	@sed -n 's/^# //p' Makefile

demo: install
	.venv/bin/scene-envs demo output=runs/demo

test: install-dev
	$(PYTEST) --doctest-modules $(PAGES:%=--ignore=%) scene_envs rewards agents configs tests $(ARGS)

test-gpu: install-dev
	SCENE_ENVS_TEST_DEVICE=$(DEVICE) $(ENV) .venv/bin/python -m pytest -m gpu -p no:randomly tests/gpu $(ARGS)

test-docs: install-dev
	$(PYTEST) $(PAGES) $(ARGS)

lint: install-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

docs: install-dev
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict
	@echo "Wrote site/index.html."

check:
	bash .ci/run

install: .venv/installed

install-dev: .venv/installed-dev

.venv/installed: pyproject.toml constraints.txt
	@sh .ci/make-venv "$(PYTHON)"
	@echo "Installing SceneEnvs into .venv (once, some minutes on a slow network) ..."
	@$(INSTALL) -e .
	@touch $@

.venv/installed-dev: .venv/installed
	@echo "Installing the test tools into .venv ..."
	@$(INSTALL) -e ".[dev]"
	@touch $@

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .mypy_cache .ruff_cache
