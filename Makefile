# The doors of this house. `make demo` and `make test` set up all they need by themselves.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO := demo

.PHONY: setup demo pictures test check lint house bench results fuzz wheel release docs sample lock clean
.DELETE_ON_ERROR:

setup: $(STAMP)

# The stamp is younger than the lock file only after everything in it was installed.
$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r requirements.lock
	$(BIN)/python -m compileall -qq -j 0 -x '/tests?/' $(VENV)/lib || true  # as pip does, but for tests, on all cores
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $(STAMP)

demo: setup
	@echo "The sample flight takes some five minutes. mocap is $(BIN)/mocap."
	mkdir -p $(DEMO)
	$(BIN)/mocap models fetch blazepose
	$(BIN)/mocap ingest sample_data/mound_walk/flight.yaml -o $(DEMO)/mound_walk.session
	$(BIN)/mocap reconstruct $(DEMO)/mound_walk.session --workers 2
	$(BIN)/mocap replan-compare $(DEMO)/mound_walk.session
	$(BIN)/mocap report $(DEMO)/mound_walk.session
	$(BIN)/mocap export $(DEMO)/mound_walk.session --to trc,csv,tum --overwrite
	@echo "Open $(DEMO)/mound_walk.session/report/index.html in a browser."

# The moving picture of README and that of the report, from the demo.
pictures: demo
	$(BIN)/python docs/pictures.py $(DEMO)/mound_walk.session

# Python and pytest keep what they compile, even where the environment says otherwise: tests and the commands
# under test begin sooner.
test: setup
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder \
	    --durations 20 --durations-min 5 --junitxml build/tests.xml

# Lint and the tests that need the least time: under a minute on two cores, once mypy and Numba have their caches.
QUICK := session drafting geometry planning $(addprefix formats/,calibrations common keypoint_files poses skeletons)

check: lint
	$(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m "not slow and not long" $(addprefix tests/,$(QUICK))

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir build/site

# The size of this house against the aims of its upkeep.
house: setup
	$(BIN)/python -m benchmarks.house

# The table of all times, beside peers.
bench: setup
	$(BIN)/python -m benchmarks.speed

# The sample's tables of docs/results.md again, in some ten minutes.
results: setup
	$(BIN)/mocap models fetch blazepose
	$(BIN)/python -m benchmarks.results

# Damaged files and crafted ones into every reader, attacks by others' sessions, commands killed at fifty
# moments, and losses of power, for some minutes each.
fuzz: setup
	$(BIN)/python -m tests.fuzz --inputs 2000
	$(BIN)/python -m tests.fuzz --crafted
	$(BIN)/python -m tests.fuzz --foreign 200
	$(BIN)/python -m tests.kills --kills 50
	$(BIN)/python -m tests.kills --power
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m long

# The wheel in an empty environment.
wheel:
	.ci/wheel

# A wheel and an sdist in dist/, checked as the package index checks them.
release:
	rm -rf dist build/lib build/release
	$(PYTHON) -m venv build/release
	build/release/bin/python -m pip install --quiet --disable-pip-version-check build twine
	build/release/bin/python -m build --quiet --outdir dist
	build/release/bin/python -m twine check --strict dist/*

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir build/site

# Make the sample flight again: the same logs and truth as in the repository, byte for byte.
sample: setup
	$(BIN)/mocap simulate --example mound_walk -o sample_data/mound_walk --force

# Pin the newest versions that pyproject.toml allows (needs uv).
lock:
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --upgrade \
	    --generate-hashes --no-emit-index-url --no-emit-find-links --no-annotate --no-header -o requirements.lock

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
