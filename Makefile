PYTHON ?= python3
BIN := .venv/bin
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# Tests start a thousand processes: each would compile the package anew if none kept its bytecode.
export PYTHONDONTWRITEBYTECODE =
# Some tests wait for other processes: one test process more than cores.
WORKERS := $(shell echo $$((1 + $$(nproc))))
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile
# A comma in an argument of `call` would end it.
CHARTS := charts,fast,peers
# uv takes an eighth of the time of pip, which installs where uv fails: it reads no pip.conf.
# Neither compiles: modules are when they are first imported, and most of these packages' never are.
install = $(BIN)/uv pip install --quiet --python $(BIN)/python $(1) || $(PIP) $(1)
# A test process that crashes ends the run with its test's name; where another was started in its
# place, pytest-xdist 3.8 waited for ever.
PARALLEL := -n $(WORKERS) --dist loadscope --no-loadscope-reorder --max-worker-restart=0
ALL_TESTS = SPARSESKIN_EXAMPLES=50 $(ONE_THREAD) $(CURDIR)/$(BIN)/python -m pytest -q $(PARALLEL) --durations=20

.PHONY: dist demo shots gallery charts charts-quick stress stress-quick
.PHONY: test test-all test-dist test-core coverage test-kernels check mutants docs hooks clean
.DELETE_ON_ERROR:

# The main job: a wrench dragged over 64 x 64 taxels, through four processes: 5350 frames, a minute.
demo: .venv/compiled
	$(BIN)/sparseskin launch drag_wrench_64 --set sensor.rate_hz=100

# Pictures of the live page in several states, in docs/ (needs chromium, chromium-driver).
shots: .venv/installed-dev
	PYTHONPATH=tests $(BIN)/python docs/pictures/shots.py $(SHOTS)

# What the examples print and draw, for their pages in docs/ (three minutes).
gallery: .venv/installed-dev
	$(ONE_THREAD) $(BIN)/python docs/pictures/examples.py $(EXAMPLES)

# The tables and charts of four studies, in out/ (50 minutes; the quick ones 8).
charts charts-quick: .venv/installed-charts
	for study in paper-tables speed-accuracy stability scene-needs; do \
	    $(BIN)/sparseskin study $$study $(if $(findstring quick,$@),--quick) || exit; \
	done

# The tests that take seconds at most; of some folders: make test TESTS=tests/nodes/player.
test: .venv/installed-test
	$(ONE_THREAD) $(BIN)/python -m pytest -q $(PARALLEL) -m "not slow" $(TESTS)

# All tests, those that are slow by nature too (kills, soak, browser, network namespaces).
test-all: .venv/installed-dev
	$(ALL_TESTS)

# The distribution in dist/; and all tests as its sdist holds them, with its wheel installed.
dist: .venv/installed-dev
	rm -rf dist
	$(BIN)/python -m build > /dev/null

test-dist: dist
	$(call install,--no-deps dist/*.whl)
	rm .venv/installed*  # of the repository itself, which the wheel has replaced
	tar --extract --gzip --file dist/*.tar.gz --directory dist
	cd dist/sparseskin-*/ && PYTHONSAFEPATH=1 $(ALL_TESTS) $(TESTS)

# All tests of the core, in a copy of the repository without the plug-ins.
test-core: .venv/installed-dev
	$(BIN)/python .ci/core.py all

# Faults, fuzz, attacks, soak, endurance and the costs of bridges and of readers, at the sizes whose
# figures are in docs/ (6 hours; the quick ones 5 minutes); some: make stress STRESS=test_soak.py.
stress stress-quick: .venv/installed-dev
	$(if $(findstring quick,$@),,SPARSESKIN_STRESS=full SPARSESKIN_FAST=auto) $(ONE_THREAD) $(BIN)/python -m pytest -q \
	    -p no:xdist --timeout=0 $(addprefix tests/stress/,$(or $(STRESS),.))

# The same with the coverage of what runs in the test processes, which takes them half as long again.
coverage: .venv/installed-dev
	$(ONE_THREAD) $(BIN)/python -m pytest -q $(PARALLEL) \
	    --cov=messages --cov=nodes --cov=launch --cov=studies --cov=plugins --cov=sparseskin --cov-report=term:skip-covered

# Mutation testing: a sample of mutants of each area of the core, and the share that tests catch
# (three hours); some areas: make mutants AREAS="node network".
mutants: .venv/installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[mutants]'
	$(ONE_THREAD) $(BIN)/python .ci/mutants.py $(AREAS)

# The tests of solvers and operators under each kernel of OpenBLAS that this host can run.
test-kernels: .venv/installed-dev
	$(ONE_THREAD) $(BIN)/python .ci/kernels.py

# The documentation site in out/site, warnings being errors.
docs: .venv/installed-docs
	$(BIN)/python docs/site_pages.py out
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

# The checks before each commit (.pre-commit-config.yaml).
hooks: .venv/installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check pre-commit
	$(BIN)/pre-commit install

check: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m mypy --package sparseskin
	$(BIN)/python .ci/packing.py
	$(BIN)/python .ci/core.py

.venv/python:
	$(PYTHON) -m venv .venv
	$(PIP) uv || true
	touch $@

.venv/installed: pyproject.toml .venv/python
	$(call install,-e '.[fast]')
	touch $@

# Compiled loops are kept beside their module: a demo starts at once.
.venv/compiled: .venv/installed nodes/numerics/kernels.py
	$(BIN)/python -m sparseskin.nodes.numerics.warm_up
	touch $@

.venv/installed-charts: pyproject.toml .venv/python
	$(call install,-e '.[$(CHARTS)]')
	touch $@ .venv/installed

.venv/installed-test: pyproject.toml .venv/python
	$(call install,-e '.[test]')
	touch $@ .venv/installed

.venv/installed-dev: pyproject.toml .venv/python
	$(call install,-e '.[dev]')
	touch $@ .venv/installed .venv/installed-test

.venv/installed-docs: pyproject.toml .venv/python
	$(call install,-e '.[docs]')
	touch $@

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
