# Everything happens in .venv, which the first target that needs it makes from requirements.lock.
# `make PYTHON=/path/to/python3.11` names another interpreter.

PYTHON ?= python3.11
BIN := .venv/bin
WORKERS ?= 2
STUDIES := beyond obstacles bodies sensing boids

# what the caller's own Python set-up must not change
unexport PYTHONPATH PYTHONHOME PYTHONSTARTUP VIRTUAL_ENV PIP_USER PIP_TARGET PIP_PREFIX

.DELETE_ON_ERROR:
.PHONY: help run test test-slow lint format benchmark docs reproduce lock clean clean-kernels .venv FORCE

help:  ## this list
	@sed -n 's/^\([a-z.-]*\):[^#]*##  *\(.*\)/\1|\2/p' $(MAKEFILE_LIST) | while IFS='|' read -r name text; do printf '  make %-10s %s\n' "$$name" "$$text"; done

run: build/.installed  ## play a few trials of our best policy beside the best heuristic and write results/
	$(BIN)/shepherd-phys evaluate --controllers collie occlusion --flocks 1 2 --trials 4 --workers $(WORKERS) --out results

test: lint  ## style, types, and the fast tests
	$(BIN)/pytest -n $(WORKERS) -m "not slow"

test-slow: build/.installed  ## the longer proofs
	$(BIN)/pytest -n $(WORKERS) -m slow

lint: build/.installed  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: build/.installed  ## repair what ruff can repair
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

benchmark: build/.installed  ## measure the speed of the simulator
	$(BIN)/shepherd-phys benchmark

docs: build/.installed  ## the guide as pages, in build/docs/html
	$(BIN)/python -m sphinx -W --keep-going --quiet -d build/docs/doctrees docs build/docs/html
	@echo build/docs/html/index.html

reproduce: build/.installed  ## run the paper's experiments (hours; continues) and put the results into docs/reproduction/
	$(BIN)/shepherd-phys reproduce all --literal --workers $(WORKERS) --out results/reproduce
	for name in $(STUDIES); do $(BIN)/shepherd-phys reproduce $$name --workers $(WORKERS) --out results/reproduce || exit 1; done
	mkdir -p docs/reproduction
	for name in figure2 figure3 $(STUDIES); do for kind in csv md png; do \
		cp results/reproduce/$$name.$$kind docs/reproduction/ || exit 1; done; done
	cp results/reproduce/figure[23]-differences.csv docs/reproduction/
	cp results/reproduce/claims.json results/reproduce/claims.md docs/reproduction/

.venv: build/.installed  ## the whole development environment

# An environment counts as made only once its stamp, written last, is there; anything else is begun anew.
.venv/.locked: requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "error: this project needs Python 3.11, and '$(PYTHON)' does not run one." \
		"Install it, or name it: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	rm -rf .venv
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -r requirements.lock
	touch $@

# The editable install links file by file: a file added or removed calls for a new one, an edited file does not.
build/.files: FORCE
	@mkdir -p build
	@find shepherd_phys envs controllers scripts -type f ! -path '*/__pycache__/*' | LC_ALL=C sort > $@.new
	@if cmp -s $@.new $@; then rm $@.new; else mv $@.new $@; fi

build/.installed: build/.files pyproject.toml .venv/.locked
	@rm -f $@
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable . --config-settings editable_mode=strict
	@touch $@

lock: build/.installed  ## write requirements.lock anew, keeping the versions it has (UPGRADE=1: the newest)
	CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/pip-compile --quiet --all-extras --allow-unsafe --strip-extras \
		--no-build-isolation --no-annotate --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
		$(if $(UPGRADE),--upgrade) --output-file requirements.lock pyproject.toml
	sed -i.old -e 's/+cpu$$//' -e '/^pip==/d' requirements.lock && rm requirements.lock.old

clean-kernels:  ## forget numba's compiled kernels
	find shepherd_phys envs controllers build -name '*.nb[ic]' -exec rm -f {} +

clean:  ## remove everything that was made, results and runs excepted
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
