# `make experiment` and `make test` are the two to know. Every target sets up .venv as far as it needs it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TEST_READY := $(VENV)/.test-ready
# Without its bytecode each process of the tests would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE
# A module is compiled where it is first imported: most of what comes along never is.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile

.PHONY: help setup experiment test test-long quick hooks lint browser compiled docs pictures screenshot clean

help:
	@echo "make experiment   set up and run the whole experiment against the built-in emulator"
	@echo "make test         set up and run ruff, mypy and the tests"
	@echo "make quick        run ruff and the tests nearest to the changed files, within seconds"
	@echo "make test-long    run the tests marked long, minutes each"
	@echo "make hooks        install the checks made at each commit"
	@echo "make docs         build the documentation site into site/"
	@echo "make pictures     draw the pictures of the documents again, those without a browser"
	@echo "make screenshot   take the pictures of the documents again"
	@echo "make clean        remove the virtual environment and the caches"

$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, found " + sys.version.split()[0] + "; set PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)

$(READY): pyproject.toml | $(BIN)/pip
	$(PIP) --editable '.[view]'
	@touch $(READY)

# One installation: what the tests need has in it what the experiment needs.
$(TEST_READY): pyproject.toml | $(BIN)/pip
	$(PIP) --editable '.[test]'
	@touch $(READY) $(TEST_READY)

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

# What the tests would compile in several processes at once.
compiled: $(READY)
	$(BIN)/python -m runner.compiled

test: $(TEST_READY)
	@$(MAKE) --no-print-directory -j 3 lint browser compiled
	$(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder -m "not long"

quick: $(TEST_READY)
	@$(BIN)/python .ci/quick

hooks: $(TEST_READY)
	$(BIN)/pre-commit install

# Benchmarks named in the documents, campaigns.
test-long: $(TEST_READY) browser
	$(BIN)/pytest -m long

docs: $(TEST_READY)
	$(BIN)/mkdocs build --strict --clean

pictures: $(TEST_READY)
	$(BIN)/python docs/images/draw.py

screenshot: $(TEST_READY) browser
	$(BIN)/python docs/images/take.py

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
