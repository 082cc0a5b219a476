# One command is the truth: `make check` is what the gate and the pre-commit hook call.
PYTHON ?= python3
VENV   ?= .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.setup-done
# Tests and the demo talk on this machine only.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

.DEFAULT_GOAL := help
.PHONY: help setup demo test e2e e2e-argocd check format golden bench load wheel clean

help:  ## Show what there is to make
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP)  ## Make .venv with everything in it, the ROS 2 interfaces included
	@$(PY) ros_bridge/interfaces/build.py

$(STAMP): pyproject.toml constraints.txt
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing; install Python 3.10 or newer (Debian: apt-get install python3 python3-venv)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 10) else "Python 3.10 or newer is needed, this is " + sys.version.split()[0] + "; name another with PYTHON=…")'
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "Python's venv module is missing (Debian: apt-get install python3-venv)"; exit 1; }
	@command -v git >/dev/null || { echo "git is missing (Debian: apt-get install git)"; exit 1; }
	@echo "setup: installing Python packages into $(VENV), about a minute"
	@$(PYTHON) -m venv $(VENV)
	@$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[ros,dev]'
	@touch $@

demo: setup  ## Play the paper's experiment: eight demands over ROS 2 become eight commits
	@$(PY) examples/experiment/demo.py

test: setup  ## Run all tests but the end-to-end ones
	@$(PY) -m pytest -n auto --dist loadfile tests/unit tests/golden tests/integration tests/ros

e2e: setup  ## Run the end-to-end tests on a real cluster with Flux (docs/e2e.md)
	@if [ -z "$$E2E_KUBECONFIG" ]; then $(PY) -m tests.e2e.rig.tools --for flux; fi
	@$(PY) -m pytest -p no:cacheprovider tests/e2e --ignore tests/e2e/argocd -x -q

e2e-argocd: setup  ## Run them with Argo CD
	@if [ -z "$$E2E_KUBECONFIG" ]; then $(PY) -m tests.e2e.rig.tools; fi
	@$(PY) -m pytest -p no:cacheprovider tests/e2e/argocd -x -q

check: setup  ## Format, lint, types, imports and tests
	@$(PY) -m ruff format --check .
	@$(PY) -m ruff check .
	@$(PY) -m mypy
	@$(VENV)/bin/lint-imports --no-logo
	@$(MAKE) --no-print-directory test

format: setup  ## Format the code and mend what the linter can
	@$(PY) -m ruff format .
	@$(PY) -m ruff check --fix .

golden: setup  ## Write the golden folders anew; review the diff
	@$(PY) -m tests.golden.write

bench: setup  ## Measure what a commit costs, beside the floor
	@$(PY) -m tests.benchmarks.commits

load: setup  ## Four generators and a person write at once, 2,000 demands, connections are cut
	@DEMANDOPS_LOAD_DEMANDS=2000 DEMANDOPS_LOAD_FURTHER=1000 $(PY) -m pytest -q -p no:cacheprovider tests/integration/staterepo/test_many_writers.py tests/integration/staterepo/test_people_in_the_loop.py

wheel: setup  ## Build the wheel into dist/
	@$(PY) -m build --wheel --outdir dist .

clean:  ## Remove what the other targets made
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
