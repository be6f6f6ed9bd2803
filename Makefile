# Two commands on a fresh machine: `make demo` and `make test`. Both create .venv themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-nightly test-weekly coverage versions lint docs bench bench-peers bench-check bench-figure mutants mutate-changes fuzz clean
.DELETE_ON_ERROR:
# Packages are installed without bytecode: the first process that imports one writes it for all others.
unexport PYTHONDONTWRITEBYTECODE

demo: $(VENV)/.installed
	$(BIN)/diffabs reproduce all --out out

test: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" --durations=25

# the share of lines and branches that the fast tests run; the last line is the number
coverage: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow" --cov=diffabs --cov-branch --cov-report=term:skip-covered

# two larger tiers; each writes into docs/test-status.md when it ran and what failed
test-nightly test-weekly: test-%: $(VENV)/.test $(VENV)/.ecosystem
	$(BIN)/python tests/support/tiers.py $*

lint: $(VENV)/.lint $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --threads 2
	$(BIN)/python tests/support/known_types.py
	$(BIN)/lint-imports
	$(BIN)/zizmor --offline --no-progress .github

# the site, in out/site; a warning or a dead link is an error
docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: $(VENV)/.bench
	$(BIN)/python benchmarks/bench_peers.py
	$(BIN)/python benchmarks/bench_work_precision.py
	$(BIN)/python benchmarks/bench_fields.py
	$(BIN)/python benchmarks/bench_gradient.py
	$(BIN)/python benchmarks/bench_gradient.py --rtol 1e-5 --loops lmi est
	$(BIN)/python benchmarks/bench_riccati.py
	$(BIN)/python benchmarks/bench_design.py
	$(BIN)/python benchmarks/bench_sweep.py
	$(BIN)/python benchmarks/bench_studies.py
	$(BIN)/python benchmarks/bench_yardsticks.py
	$(BIN)/python benchmarks/bench_car.py

# the same with the peers that need environments of their own
bench-peers: $(VENV)/.bench $(VENV)-torch/.installed $(VENV)-jaxonomy/.installed
	$(BIN)/python benchmarks/bench_peers.py --python \
	  torchdiffeq_event=$(VENV)-torch/bin/python jaxonomy_event=$(VENV)-jaxonomy/bin/python

$(VENV)-torch/.installed $(VENV)-jaxonomy/.installed: $(VENV)-%/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)-$*
	$(VENV)-$*/bin/python -m pip install --quiet "pip>=25.1"
	$(VENV)-$*/bin/python -m pip install --quiet --group bench-$*
	touch $@

# have ratios become worse than those stored in benchmarks/ratios.json?
bench-check: $(VENV)/.bench
	$(BIN)/python benchmarks/check.py

# error against time: the peers in float64, beside what bench_work_precision.py has written
bench-figure: $(VENV)/.bench
	$(BIN)/python benchmarks/bench_peers.py --dtype float64
	$(BIN)/python benchmarks/draw_work_precision.py --out docs/figures/work-precision.png

mutants: $(VENV)/.test
	$(BIN)/python tests/support/mutants.py

# small changes of the lines that differ from BASE, and whether the tests notice them
BASE ?= main
mutate-changes: $(VENV)/.mutate
	$(BIN)/python tests/support/mutate_changes.py --base $(BASE)

# each Python and JAX: VERSIONS="python3.11=0.10 ..."; JAX `pre` is its newest pre-release
VERSIONS ?= python3.11=0.10 python3.12=0.11 python3.13=0.12 python3.14=0.12
versions:
	$(PYTHON) tests/support/versions.py $(VERSIONS)

fuzz: $(VENV)/.test
	$(BIN)/python tests/support/fuzz_scenarios.py --count 20000 --seed 0
	$(BIN)/python tests/support/fuzz_files.py --count 2000 --seed 0

clean:
	rm -rf $(VENV) $(VENV)-torch $(VENV)-jaxonomy .jax_cache out

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "diffabs needs Python 3.11 or newer; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "pip>=25.1"
	touch $@

# --no-compile: Python compiles what is imported, and that is a small part of what is installed
$(VENV)/.installed: $(VENV)/.python pyproject.toml
	$(BIN)/python -m pip install --quiet --no-compile --editable ".[all]"
	touch $@

$(VENV)/.test $(VENV)/.lint $(VENV)/.docs $(VENV)/.bench $(VENV)/.mutate $(VENV)/.ecosystem: $(VENV)/.%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --no-compile --group $*
	touch $@
