# Two commands: `make experiment` and `make test`. Each sets up what it needs in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TEST_READY := $(VENV)/.test-ready
PIP := $(BIN)/pip install --quiet --disable-pip-version-check

.PHONY: help setup experiment test test-long lint browser screenshot clean

help:
	@echo "make experiment   set up and run the whole experiment against the built-in emulator"
	@echo "make test         set up and run ruff, mypy and the tests"
	@echo "make test-long    run the tests that take minutes each"
	@echo "make screenshot   make the pictures of the README anew"
	@echo "make clean        remove the virtual environment and the caches"

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, found " + sys.version.split()[0] + "; set PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable '.[view]'
	@touch $(READY)

$(TEST_READY): $(READY)
	$(PIP) --editable '.[test]'
	@touch $(TEST_READY)

setup: $(TEST_READY) browser

experiment: $(READY)
	$(BIN)/lwr-run experiment --yes

# The tests of the report and the preview open them in Chromium, a package of the system.
browser:
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null \
		|| echo "chromium could not be installed; the tests in a browser will be left out"; \
	else \
		echo "no chromium: the tests in a browser will be left out; install it with: sudo apt-get install chromium"; \
	fi

lint: $(TEST_READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint browser
	$(BIN)/pytest -n auto --dist loadfile -m "not long"

# What takes longer: benchmarks named in the documents, campaigns.
test-long: $(TEST_READY) browser
	$(BIN)/pytest -m long

screenshot: $(TEST_READY) browser
	$(BIN)/python docs/images/take.py

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
