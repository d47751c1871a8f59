# Sets everything up in .venv and bakes, tests, benchmarks or lints with the wheel of this tree.
#
#   make [bake] [ENV=image] [OUT=folder] [ARGS='--size 512 ...']     bakes the demo or your environment
#   make test | test-long | test-all [ARGS='-k name']                minutes | those that take longer | both
#   make test-plain                                                  the wheel without any extra
#   make test-engines                                                three.js, Babylon.js, Filament in Chromium
#   make bench | lint | devices | clean

# `=`, not `?=`: a variable ENV of the shell means something else.
ENV = demo
OUT = baked
ARGS =
PYTHON = python3

VENV := .venv
BIN := $(VENV)/bin
WHEEL = $$(ls $(VENV)/wheel/*.whl)
# Folders too: theirs is the time that changes when a file goes.
SOURCES := setup.cfg pyproject.toml LICENSE $(wildcard README.md) \
  $(shell find host kernels -name __pycache__ -prune -o -name '*.egg-info' -prune -o -print)

# A recipe is one script that stops at its first failure.
.ONESHELL:
.SHELLFLAGS = -ec
.DELETE_ON_ERROR:
.PHONY: bake test test-long test-all test-plain test-engines bench lint devices clean
export PIP_DISABLE_PIP_VERSION_CHECK = 1
# What is tested is the wheel, whatever the caller's shell has on its path.
unexport PYTHONPATH

bake: $(VENV)/device.done
	@$(BIN)/whitefurnace bake "$(ENV)" -o "$(OUT)" $(ARGS)

# Two processes are as many as PoCL's own threads leave room for on two cores; more do not pay on four.
PYTEST = $(BIN)/pytest -n 2 --dist worksteal

# An engine's page costs seconds of a browser: `make test-engines` runs those.
test: $(VENV)/device.done $(VENV)/test.done
	@$(PYTEST) -m "not long and not engines" $(ARGS) tests

test-long: $(VENV)/device.done $(VENV)/test.done
	@$(PYTEST) -m "long and not engines" --durations=10 $(ARGS) tests

test-all: $(VENV)/device.done $(VENV)/test.done
	@$(PYTEST) --durations=10 $(ARGS) tests

# An environment that has the wheel alone; a runtime from pip comes along where the system has none.
test-plain: $(VENV)/device.done
	@rm -rf $(VENV)/plain
	$(PYTHON) -m venv $(VENV)/plain
	$(VENV)/plain/bin/pip install --quiet "$(WHEEL)"
	$(VENV)/plain/bin/whitefurnace devices >/dev/null 2>&1 || {
		$(BIN)/pip freeze | grep -iE '^(pocl|intel)' | xargs $(VENV)/plain/bin/pip install --quiet
	}
	$(VENV)/plain/bin/python tests/plain_install.py

# What they need and cannot be had is a reason to skip them, told at the end.
test-engines: $(VENV)/device.done $(VENV)/test.done $(VENV)/engines/node_modules
	@export WHITEFURNACE_NODE_MODULES="$${WHITEFURNACE_NODE_MODULES:-$(CURDIR)/$(VENV)/engines/node_modules}"
	$(BIN)/pytest -m engines $(ARGS) tests/engines/test_engines.py

bench: $(VENV)/device.done $(VENV)/test.done
	@for file in benchmarks/*.py; do $(BIN)/python "$$file" $(ARGS); done

lint: $(VENV)/lint.done
	@$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --config-file= --strict tests/typed_use.py

devices: $(VENV)/installed.done
	@$(BIN)/whitefurnace devices

clean:
	@rm -rf $(VENV) build host/*.egg-info .pytest_cache .mypy_cache .ruff_cache

$(VENV)/created.done:
	@echo "Making $(VENV)."
	$(PYTHON) -m venv $(VENV) || {
		echo "No virtual environment could be made: install Python's venv (Debian: apt install python3-venv)."
		exit 1
	} >&2
	touch $@

# The folder build/ of an earlier wheel would bring deleted modules back.
$(VENV)/installed.done: $(VENV)/created.done $(SOURCES)
	@echo "Installing whitefurnace."
	rm -rf build host/*.egg-info $(VENV)/wheel
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir $(VENV)/wheel .
	rm -rf build host/*.egg-info
	$(BIN)/pip install --quiet "$(WHEEL)"
	$(BIN)/pip install --quiet --no-deps --force-reinstall "$(WHEEL)"
	touch $@

$(VENV)/test.done $(VENV)/lint.done: $(VENV)/%.done: setup.cfg | $(VENV)/installed.done
	@$(BIN)/pip install --quiet "$(WHEEL)[$*]"
	touch $@

# The browser from Debian, where this may install; the engines from npm.
$(VENV)/engines/node_modules: tests/engines/package.json | $(VENV)/installed.done
	@if ! { command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null &&
		[ -z "$$WHITEFURNACE_CHROMIUM" ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
		echo "Installing Chromium from Debian."
		export DEBIAN_FRONTEND=noninteractive
		timeout 120 apt-get -qq update || true
		timeout 300 apt-get -qq install --yes --no-install-recommends chromium >/dev/null || true
	fi
	if [ -n "$$WHITEFURNACE_NODE_MODULES" ] || ! command -v npm >/dev/null; then exit 0; fi
	echo "Installing the engines from npm."
	mkdir -p $(VENV)/engines
	cp tests/engines/package.json $(VENV)/engines
	if timeout 300 npm install --ignore-scripts --no-audit --no-fund --silent --prefix $(VENV)/engines; then
		touch $@
	else
		echo "npm could not."
		rm -rf $@
	fi

# A device that is listed is not one that works, so each source of one is tried and asked; once.
$(VENV)/device.done: $(VENV)/installed.done
	@works() { $(BIN)/whitefurnace devices >/dev/null 2>&1; }
	if ! works; then
		echo "No OpenCL device works yet; trying PoCL from PyPI."
		$(BIN)/pip install --quiet pocl-binary-distribution || true
		works || $(BIN)/pip uninstall --quiet --yes pocl-binary-distribution || true
	fi
	if ! works && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
		echo "None works yet; trying Debian's PoCL."
		export DEBIAN_FRONTEND=noninteractive
		apt-get -qq update || true
		apt-get -qq install --yes --no-install-recommends pocl-opencl-icd >/dev/null || true
	fi
	if ! works; then
		echo "None works yet; trying Intel's OpenCL runtime from PyPI (0.9 GB, Intel's own licence)."
		$(BIN)/pip install --quiet intel-opencl-rt intel-cmplr-lib-rt || true
		works || $(BIN)/pip uninstall --quiet --yes intel-opencl-rt intel-cmplr-lib-rt || true
	fi
	if ! works; then
		$(BIN)/whitefurnace devices || true
		echo "No OpenCL device works: install a GPU vendor's driver or PoCL (Debian: apt install pocl-opencl-icd)"
		echo "and run make again."
		exit 1
	fi >&2
	touch $@
