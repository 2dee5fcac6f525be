# make test      set up a virtual environment and run every check and test
# make test-long   campaigns, deep fuzzing, every page of the browser, whole demonstrations: 45 minutes
# make check     the checks alone: style, types, which package may import which, links of the pages
# make docs      write the tables of docs/settings.md and docs/numbers.md, then the site docs/_build/
# make pictures  make the pictures of the documentation again; those of the viewer need Chromium
# make pretrained   train the MLP that regions begin with, on simulated streets: 10 minutes
# make bench     how fast and how good triquad is on this machine; PART=core: one part of it
# make campaign  try for 5 minutes to break a server and its files; CAMPAIGN_MINUTES=60: for an hour
# make paper    the experiments of the 3QFP paper in simulated worlds, for docs/paper.md: 45 minutes
# make wheel     build sdist and wheel, and try them in a clean environment; PYTHON=python3.12
# make demo      set up a virtual environment and map a street, end to end
VENV ?= .venv
PYTHON ?= python3
# Extra flags for pip; --extra-index-url https://download.pytorch.org/whl/cpu takes torch's CPU build.
PIP_FLAGS ?=
# How long make campaign takes; it goes on with what is in campaign-out/.
CAMPAIGN_MINUTES ?= 5

# Compiled Python is kept: without it, each of the many processes starts four seconds later.
unexport PYTHONDONTWRITEBYTECODE

BIN = $(VENV)/bin
# What is installed: without torch for the demonstration, with everything for all else.
INSTALLED_DEMO = $(VENV)/.installed-demo
INSTALLED = $(VENV)/.installed

# What pip says is of interest where it fails.
PIP_LOG = $(VENV)/pip.log
define pip_install
	@echo "installing what '$(1)' needs into $(VENV) ..."
	@$(BIN)/python -m pip install --no-compile $(PIP_FLAGS) -c constraints.txt -e '.[$(1)]' \
	  > $(PIP_LOG) 2>&1 || { tail -n 30 $(PIP_LOG); exit 1; }
endef

.PHONY: bench campaign check clean demo docs kernels paper pictures pretrained test test-long wheel

demo: $(INSTALLED_DEMO)
	$(BIN)/triquad-demo --out demo-out

# Kernels, those of a server and those of the simulator, are compiled once, not by every process
# that tests. Three of these keep two cores busy, as tests wait for servers; with threads of torch's
# own they would wait for each other.
test: $(INSTALLED)
	$(MAKE) -j2 check kernels
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 3 -m "not long" --durations=10

kernels: $(INSTALLED)
	$(BIN)/python -m triquad_server.warm_up
	PYTHONPATH=tests $(BIN)/python -c \
	  "from support.maps.small_world import world; world(1).scene.sdf(world(1).hits)"

test-long: kernels
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 3 -m long --durations=10

docs: $(INSTALLED)
	$(BIN)/python docs/settings_tables.py
	$(BIN)/python docs/numbers_table.py
	$(BIN)/sphinx-build -q -E -W --keep-going docs docs/_build

paper: $(INSTALLED_DEMO)
	PYTHONPATH=. $(BIN)/python -m bench.paper

pictures: $(INSTALLED)
	PYTHONPATH=. $(BIN)/python docs/pictures.py
	PYTHONPATH=. $(BIN)/python docs/top_picture.py
	PYTHONPATH=. $(BIN)/python docs/viewer_pictures.py

bench: $(INSTALLED)
	$(BIN)/python -m bench $(PART) $(BENCH_FLAGS)

campaign: $(INSTALLED)
	PYTHONPATH=tests $(BIN)/python -m bench.campaign --minutes $(CAMPAIGN_MINUTES)

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=. $(BIN)/lint-imports
	$(BIN)/python -m pytest -q tests/end_to_end/documents/test_references.py -k links

$(INSTALLED_DEMO): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(call pip_install,demo)
	@touch $@

$(INSTALLED): $(INSTALLED_DEMO)
	$(call pip_install,dev)
	@touch $@

# What is in the wheel, and nothing of this folder, maps a few scans in an environment of its own.
wheel:
	rm -rf dist
	$(PYTHON) -m venv dist/try
	dist/try/bin/python -m pip install -q $(PIP_FLAGS) build
	dist/try/bin/python -m build -q --outdir dist .
	dist/try/bin/python -m pip install -q --no-compile $(PIP_FLAGS) "$$(ls dist/*.whl)[demo]"
	cd dist && try/bin/triquad-demo --scans 5 --out demo-out
	rm -rf dist/try dist/demo-out

pretrained: $(INSTALLED)
	$(BIN)/python -m bench.studies.pretraining

clean:
	rm -rf $(VENV) demo-out docs/_build
