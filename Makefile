# Two commands do everything: `make fly` and `make test`. `make test-all` takes longer, and
# `make docs` and `make man` build the documentation and the manual page.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
JOBS   ?= 3
SOURCES := mavfi_cli sitl tests benchmarks examples
SPHINX  := PATH="$(abspath $(BIN)):$$PATH" $(BIN)/sphinx-build -q -W --keep-going -E

# Each of the thousand processes of the tests would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: fly test test-all checked docs man install install-dev lint compiled clean

fly: install
	$(BIN)/mavfi fly --world dense --inject planning

test: checked
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m "not slow"
	@echo "Left out: tests marked slow. 'make test-all' runs them too, and so does CI."

test-all: checked
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

# Types are checked on one core while the kernels are compiled on the other.
checked: install-dev
	@$(MAKE) --no-print-directory --jobs 2 --output-sync lint compiled

docs: install-dev
	$(SPHINX) -b html docs build/docs
	@echo "Open build/docs/index.html"

man: install-dev
	$(SPHINX) -b man docs build/man

lint: install-dev
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/lint-imports

compiled: install-dev
	$(BIN)/python -c "from mavfi_cli.autonomy.warm import warm_up; warm_up()"

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "mavfi needs Python 3.11 or newer; name one with: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "a system package is missing; install it with: apt-get install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) build *.egg-info
