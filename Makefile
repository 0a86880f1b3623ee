# make demo    steer the shipped prior and write runs/demo/report.html
# make test    run the tests
# Each is the only command needed on a Linux machine with Python 3.11; the first one installs into .venv.

JOBS ?= 2
SEED ?= $(shell date +%s)
ENV := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1
PIP := .venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt

.PHONY: demo test lint install install-dev clean help

help:
	@sed -n 's/^# //p' Makefile

demo: install
	.venv/bin/scene-envs demo output=runs/demo

test: install-dev
	$(ENV) .venv/bin/python -m pytest --randomly-seed=$(SEED) -n $(JOBS) --dist worksteal --doctest-modules scene_envs rewards agents configs tests

lint: install-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

install: .venv/installed

install-dev: .venv/installed-dev

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	@echo "Installing SceneEnvs into .venv (once, some minutes on a slow network) ..."
	$(PIP) -e .
	@touch $@

.venv/installed-dev: .venv/installed
	@echo "Installing the test tools into .venv ..."
	$(PIP) -e ".[dev]"
	@touch $@

.venv/bin/python:
	@sh .ci/make-venv "$(PYTHON)"

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
