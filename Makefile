# `make demo` and `make test` need nothing but Python 3.11 or newer: each sets up .venv/ the first time.
# Another Python: make PYTHON=python3.12 test

PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-slow mutants lint docs report applications bench clean

help:
	@echo "make demo       relight two objects with real maps; pictures and a table go to output/relight"
	@echo "make test       the tests, without the slow ones"
	@echo "make test-slow  the slow tests: examples, notebooks, convergence"
	@echo "make mutants    small faults put into a copy of the package; each has to be caught by the test named for it"
	@echo "make lint       ruff and pyright"
	@echo "make docs       these pages, the API and the notebooks, run, to output/docs/index.html; DOCS_FAST=1 runs no notebook"
	@echo "make report     speed against error, beside other methods, to output/report; QUICK=1 for a few of them, PAGES=1 also to docs"
	@echo "make applications  the same for shadows, balls of light, mirrors, measurements, BRDF matrices"
	@echo "make bench      studies behind the choices of the library: axes, kernels, recurrences, planning, stability"
	@echo "make clean      remove .venv and output"

demo: $(VENV)/.demo
	$(RUN) examples/relight.py --output output/relight --overwrite

test: $(VENV)/.test
	$(RUN) -m pytest -n 2 --dist loadfile -m "not slow"

test-slow: $(VENV)/.test
	$(RUN) -m pytest -n 2 --dist loadfile -m slow

mutants: $(VENV)/.test
	$(RUN) -m pytest -n 2 tests/test_mutants.py

lint: $(VENV)/.test
	$(RUN) -m ruff check .
	$(RUN) -m pyright --pythonpath $(RUN)

docs: $(VENV)/.docs
	$(RUN) -m sphinx -q -W --keep-going -d output/doctrees docs output/docs

ALLOCATOR := MALLOC_ARENA_MAX=1 MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=4000000000 MALLOC_TOP_PAD_=1000000000

report: $(VENV)/.bench
	$(ALLOCATOR) $(RUN) -m tests.bench.report $(if $(QUICK),--quick) $(if $(PAGES),--pages)

applications: $(VENV)/.test
	$(ALLOCATOR) $(RUN) -m tests.bench.report --only applications $(if $(QUICK),--quick) $(if $(PAGES),--pages)

bench: $(VENV)/.test
	$(ALLOCATOR) $(RUN) -m tests.bench.run --pages

clean:
	rm -rf $(VENV) output

# One stamp per set of packages, renewed when pyproject.toml changes.
$(VENV)/.demo: pyproject.toml | $(VENV)/.created
	@echo "Installing what the demo needs into $(VENV)/ ..."
	@$(RUN) -m pip install --quiet --disable-pip-version-check -e '.[demo]'
	@touch $@

$(VENV)/.docs: pyproject.toml | $(VENV)/.created
	@echo "Installing what the pages need into $(VENV)/ ..."
	@$(RUN) -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	@touch $@ $(VENV)/.demo

$(VENV)/.test: pyproject.toml | $(VENV)/.created
	@echo "Installing what the tests need into $(VENV)/ ..."
	@$(RUN) -m pip install --quiet --disable-pip-version-check -e '.[test]'
	@touch $@ $(VENV)/.demo $(VENV)/.docs

$(VENV)/.bench: pyproject.toml | $(VENV)/.created
	@echo "Installing what the report compares with into $(VENV)/ ..."
	@$(RUN) -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	@touch $@ $(VENV)/.test $(VENV)/.docs $(VENV)/.demo

$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "shisd needs Python 3.11 or newer, and '$(PYTHON)' is not. Name one: make PYTHON=python3.12 demo" >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) || { \
	  echo "Could not make a virtual environment. On Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	@touch $@
