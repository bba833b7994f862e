# What a fresh Debian machine needs: make, python3 (3.11 or newer) and python3-venv. Everything else lands in .venv.
#
#   make run   [ARGS="--duration 10"]   the bridge with its built-in scenario
#   make test  [ARGS="-k ring"]         all tests, those on real SocketCAN included
#   make studies                        the studies of several minutes, whole
#   make fuzz  [TARGET="blf sbg"] [RUNS=1000000] [SECONDS=600]  atheris on the parsers, for hours; writes docs/fuzzing.md
#   make reliability                    every fault once, measured; writes docs/reliability.md
#   make soak  [MINUTES=30]             1 kHz with random faults: accounting, recording and memory are checked at the end
#   make lint                           ruff, mypy, import rules
#   make dev                            .venv with everything that a developer needs
#   make vcan                           install what the SocketCAN tests need on a kernel without CAN (Debian, root or sudo)
#   make browser                        install the browser that the tests of the window need (Debian, root or sudo)
#   make clean                          remove .venv, caches and build results

SHELL := /bin/bash
PYTHON ?= python3
ARGS ?=
MINUTES ?= 30

# Installs $$packages.
define INSTALL
[ `id -u` = 0 ] || root=sudo; \
	echo "Installing $$packages ..."; \
	install() { DEBIAN_FRONTEND=noninteractive $$root apt-get install -qq -y --no-install-recommends $$packages >/dev/null; }; \
	install 2>/dev/null || { $$root apt-get update -qq && install; }
endef

.PHONY: run test studies fuzz reliability soak lint dev vcan browser clean
.DELETE_ON_ERROR:

run: .venv/.installed-run
	@.venv/bin/hil run $(ARGS)

test: .venv/.installed-test
	@tools/test.sh $(ARGS)

studies: .venv/.installed-test
	@.venv/bin/python -m pytest -m study $(ARGS)

fuzz: .venv/.installed-fuzz
	@.venv/bin/python tests/fuzz/run.py --runs $(or $(RUNS),1000000) --seconds $(or $(SECONDS),0) $(TARGET)

reliability: .venv/.installed-test
	@tools/reliability.sh

soak: .venv/.installed-run
	@tools/soak.sh $(MINUTES) $(ARGS)

lint: .venv/.installed-dev
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports --no-logo

dev: .venv/.installed-dev

.venv/.installed-run: EXTRAS = dashboard,logs
.venv/.installed-test: EXTRAS = dashboard,logs,plot,magnetic,mcap,test
.venv/.installed-fuzz: EXTRAS = logs,magnetic,test,fuzz
.venv/.installed-dev: EXTRAS = dashboard,logs,plot,magnetic,mcap,test,dev

.venv/.installed-%: pyproject.toml constraints.txt | .venv/bin/pip
	@echo "Installing dtg-hil[$(EXTRAS)] into .venv (takes a minute or so the first time) ..."
	@.venv/bin/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@touch $@

.venv/bin/pip:
	@command -v $(PYTHON) >/dev/null || { echo "No $(PYTHON) here: apt-get install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "dtg-hil needs Python 3.11 or newer, $(PYTHON) is `$(PYTHON) -V`: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make virtual environments here: apt-get install python3-venv" >&2; exit 1; }
	@echo "Creating .venv with `$(PYTHON) -V` ..."
	@$(PYTHON) -m venv .venv

vcan:
	@packages="user-mode-linux busybox-static iproute2 kmod can-utils"; \
	grep -qw amx_tile /proc/cpuinfo && packages="$$packages gcc libc6-dev"; \
	$(INSTALL)

browser:
	@packages="chromium fonts-dejavu-core"; \
	$(INSTALL)

clean:
	rm -rf .venv .fuzz build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find hil drivers nav fixtures tests -name __pycache__ -prune -exec rm -rf {} +
