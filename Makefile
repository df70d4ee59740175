# Every target sets up what it needs in .venv; nothing else has to be installed but Python >= 3.11, make and, for the tests, a C compiler.
# Options reach the demo through ARGS:  make demo ARGS="--seed 7 --instruction 'grab the blue block'"

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
ARGS ?=
# $(call install,what,arguments of pip install): one line with the time it took; all that pip said if it fails.
install = @printf '  %-52s ' '$(1)'; begun=$$(date +%s); \
  if $(PIP) $(2) > $(VENV)/.pip.log 2>&1; then echo "$$(($$(date +%s) - begun)) s"; \
  else echo failed; cat $(VENV)/.pip.log; exit 1; fi
PYTHONS ?= python3.11 python3.12 python3.13
JOBS ?= 2
# Many of these tests wait for something, so more of them than cores run at a time.
UNIT_JOBS ?= 4
ROS_JOBS ?= 3
# A ROS test that failed runs once more, and the summary names it: a rerun is a fault to look into.
RERUN := --reruns 1 --rerun-show-tracebacks -raR

DEMO_PACKAGES := $(shell sed -n 's|^\./||p' requirements.txt)
FLEET_PACKAGES := plugins/rn-robot-bases
SO101_PACKAGES := plugins/rn-robot-lerobot
LEARNED_PACKAGES := plugins/rn-vla plugins/rn-runtime-torch plugins/rn-backend-oft plugins/rn-policy-cubes
# A folder that a package has left behind holds no project.
ALL_PACKAGES := roboneuron-core $(sort $(patsubst %/pyproject.toml,%,$(wildcard plugins/rn-*/pyproject.toml))) .
# It compiles ROS 2 types and needs a C++ compiler; without one the rest works, and its tests are skipped.
COMPILED := plugins/rn-driver-ros2control
comma := ,
WITH_EXTRAS := $(patsubst %/rn-backend-openpi,'%/rn-backend-openpi[ray]',$(patsubst %/rn-backend-pi0,'%/rn-backend-pi0[native]',\
  $(patsubst %/rn-recorder,'%/rn-recorder[export]',\
  $(patsubst %/rn-locator-transformers,'%/rn-locator-transformers[detectors]',\
  $(patsubst %/rn-perception-camera,'%/rn-perception-camera[calibration]',\
  $(patsubst %/rn-eval,'%/rn-eval[ray$(comma)serve]',$(patsubst %/rn-metrics,'%/rn-metrics[otlp]',$(filter-out $(COMPILED),$(ALL_PACKAGES)))))))))
SOURCES := $(wildcard $(addsuffix /src,$(ALL_PACKAGES)))
PROJECTS := $(addsuffix /pyproject.toml,$(ALL_PACKAGES)) constraints.txt requirements.txt

# What each session of noxfile.py is called, a tab, and what it does.
SESSIONS = awk '/^def / && lane {sub("[(].*", "", $$2); gsub("_", "-", $$2); name = $$2; getline; \
  gsub(/^ *\"\"\"|\"\"\"$$/, ""); print name "\t" $$0} {lane = /^@lane/}' tools/lanes/*.py
LANES := $(shell $(SESSIONS) | cut -f1)

.PHONY: $(LANES) $(shell sed -nE 's/^([a-z0-9-]+):.*\#\#.*/\1/p' Makefile) test-exhaustive-units test-exhaustive-ros FORCE

help: ## show this list; what follows the empty line are sessions of noxfile.py
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 24
	@echo
	@$(SESSIONS) | expand -t 24

$(LANES): $(VENV)/.develop
	@$(BIN)/nox --session $@ -- $(ARGS)

# An environment of another project: make .venv-fr3sim
.venv-%: $(VENV)/.nox FORCE
	@$(BIN)/nox --session environment -- $*

# The learned policy needs PyTorch, which the demo otherwise does without.
demo: $(if $(findstring learned,$(ARGS)),$(VENV)/.demo-learned,$(VENV)/.demo) ## an agent picks up a cube with a simulated FR3
	@$(BIN)/roboneuron demo $(ARGS)

demo-fr3: $(VENV)/.demo-fr3 .venv-fr3sim ## the same with the driver of the real arm, against franka-sim (its own environment)
	@$(BIN)/python examples/demo_fr3.py $(ARGS)

train-cubes: $(VENV)/.demo-learned ## the small learned policy, from nothing: demonstrations, training; goes on where it was
	$(BIN)/roboneuron policy cubes train --workers $(JOBS) $(ARGS)

demo-bases: $(VENV)/.demo-bases ## an MCP client drives three mobile bases at the same time
	@$(BIN)/python examples/drive_bases.py $(ARGS)

demo-fleet: $(VENV)/.demo-fleet ## one MCP client, two FR3s and a base: both arms pick up a cube while the base drives
	@$(BIN)/python examples/demo_fleet.py $(ARGS)

demo-nav: $(VENV)/.demo-nav ## an agent drives a base to the table by nav2's NavigateToPose, then an FR3 picks up a cube
	@$(BIN)/python examples/demo_nav.py $(ARGS)

demo-so101: $(VENV)/.demo-so101 ## a simulated SO-101 picks up a cube, the simulator judges
	@$(BIN)/python examples/demo_so101.py $(ARGS)

demo-pair: $(VENV)/.demo ## two FR3s at one table: the left one hands a cube to the right one
	@$(BIN)/python examples/demo_pair.py $(ARGS)

HERE := not sourced and not peers and not gpu and not hardware and not slow and not release
DEFAULT := not exhaustive and $(HERE)
EXHAUSTIVE := exhaustive and $(HERE)
UNITS = -n $(UNIT_JOBS) --dist worksteal --max-worker-restart=0
ROS = -n $(ROS_JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart=0 $(RERUN)

test: test-units test-ros ## the default test suite, in two lanes: units and ROS; test-timing is a third

# Without --max-worker-restart=0 pytest-xdist may wait for ever when a worker crashes (seen with 3.8.0).
test-units: $(VENV)/.develop ## its tests without ROS processes, UNIT_JOBS at a time
	$(BIN)/python -m pytest $(UNITS) -m "not ros and $(DEFAULT)" $(ARGS)

# To collect the other files takes as long as a few of these tests. Those of the top-level tests/ run whole cells, which take
# all cores, most others wait: they are spread among them, the last ones before the end.
ROS_FILES = grep -rl --include='test_*.py' 'mark\.ros' $(1) | sort | awk '{print NR * $(2), $$0}'
ROS_TESTS = $(if $(ARGS),,$(shell { $(call ROS_FILES,tests,3); $(call ROS_FILES,roboneuron-core/tests plugins,2); } | \
  sort -n | cut -d ' ' -f 2))

test-ros: $(VENV)/.develop ## its tests with ROS processes, ROS_JOBS at a time
	$(BIN)/python -m pytest $(ROS) -m "ros and not timing and $(DEFAULT)" $(ROS_TESTS) $(ARGS)

test-timing: $(VENV)/.develop ## tests that judge how soon something happens, one at a time: let nothing run beside them
	$(BIN)/python -m pytest $(RERUN) -m "ros and timing and $(HERE)" $(ROS_TESTS) $(ARGS)

test-exhaustive: test-exhaustive-units test-exhaustive-ros ## further cases of what the default suite shows, in the same two lanes

test-exhaustive-units: $(VENV)/.develop
	$(BIN)/python -m pytest $(UNITS) -m "not ros and $(EXHAUSTIVE)" $(ARGS)

test-exhaustive-ros: $(VENV)/.develop
	$(BIN)/python -m pytest $(ROS) -m "ros and not timing and $(EXHAUSTIVE)" $(ROS_TESTS) $(ARGS)

test-release: $(VENV)/.develop ## every package as a wheel: what it holds, and whether it works without the sources
	$(BIN)/python -m pytest -n $(JOBS) -m release $(ARGS)

test-pythons: ## demo and bases on each of PYTHONS, in a fresh environment: what a new user gets
	$(PYTHON) tests/pythons/check.py $(PYTHONS)

check: $(VENV)/.develop ## lint, format, declared dependencies and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tools/dependencies.py
	$(BIN)/mypy $(SOURCES)
	$(BIN)/mypy --allow-subclassing-any plugins/lerobot-robot-roboneuron/src
	MYPYPATH=benchmarks:tools:plugins/rn-robot-fr3/tests:plugins/rn-view/tests:plugins/rn-link/tests:plugins/rn-backend-openpi/tests:examples $(BIN)/mypy --cache-dir .mypy_cache/benchmarks \
	  --no-explicit-package-bases --allow-subclassing-any --no-warn-return-any benchmarks tools examples noxfile.py

format: $(VENV)/.develop ## put the code into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/.docs ## build the documentation site into out/site; every link and anchor is checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python tools/check_site.py out/site
	@echo 'To read it, open this in a browser: file://$(CURDIR)/out/site/index.html'

clean: ## remove the virtual environment and everything the demo wrote
	rm -rf $(VENV) out

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python >= 3.11 is needed, this is " + sys.version.split()[0])'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(PROJECTS) | $(BIN)/python
	@echo "Setting up $(VENV) (once, about two minutes):"
	$(call install,core$(comma) ROS 2 and MCP,--constraint constraints.txt --editable roboneuron-core)
	$(call install,simulated robot$(comma) controller$(comma) backend$(comma) demo,--constraint constraints.txt \
	  $(addprefix --editable ,$(DEMO_PACKAGES)))
	@touch $@

$(VENV)/.demo-fr3: $(VENV)/.demo
	$(call install,clients of the FCI,--constraint constraints.txt 'pylibfranka; python_version < "3.13"' ruckig franky-control)
	@touch $@

$(VENV)/.demo-learned: $(VENV)/.demo
	$(call install,PyTorch,torch==2.13.0)
	$(call install,learned policy,--constraint constraints.txt $(addprefix --editable ,$(LEARNED_PACKAGES)))
	@touch $@

$(VENV)/.demo-bases: $(PROJECTS) | $(BIN)/python
	@echo "Setting up $(VENV) for the bases:"
	$(call install,core$(comma) ROS 2 and MCP,--constraint constraints.txt --editable roboneuron-core)
	$(call install,simulated bases,--constraint constraints.txt --editable plugins/rn-standard \
	  --editable plugins/rn-simulation --editable plugins/rn-robot-bases)
	@touch $@

$(VENV)/.demo-fleet: $(VENV)/.demo
	$(call install,bases,--constraint constraints.txt $(addprefix --editable ,$(FLEET_PACKAGES)))
	@touch $@

$(VENV)/.demo-nav: $(VENV)/.demo-fleet
	$(call install,types from definitions,--constraint constraints.txt --editable plugins/rn-interfaces)
	@touch $@

$(VENV)/.demo-so101: $(VENV)/.demo
	$(call install,SO-101,--constraint constraints.txt $(addprefix --editable ,$(SO101_PACKAGES)))
	@touch $@

$(VENV)/.nox: constraints.txt | $(BIN)/python
	$(PIP) --constraint constraints.txt nox
	@touch $@

$(VENV)/.docs: constraints.txt | $(BIN)/python
	$(PIP) --constraint constraints.txt mkdocs-material 'mkdocstrings[python]'
	@touch $@

# torch first and by itself: with anything else on the line pip may pick a build with gigabytes of CUDA packages.
$(VENV)/.develop: $(PROJECTS) | $(BIN)/python
	@echo "Setting up $(VENV) with every plugin and the development tools (once, about four minutes):"
	$(call install,PyTorch,torch==2.13.0)
	$(call install,core$(comma) ROS 2 and MCP,--constraint constraints.txt --editable roboneuron-core)
	$(call install,every plugin,--constraint constraints.txt $(addprefix --editable ,$(WITH_EXTRAS)))
	-$(call install,types of ros2_control (compiled),--constraint constraints.txt $(addprefix --editable ,$(COMPILED)))
	$(call install,tools for tests and checks,--constraint constraints.txt \
	  pytest pytest-timeout pytest-xdist pytest-rerunfailures deptry hypothesis ruff mypy types-psutil jsonschema types-jsonschema psutil build hatchling editables auditwheel nox towncrier \
	  ros-jazzy-test-msgs transformers mujoco franky-control 'pylibfranka; python_version < "3.13"' ruckig playwright rosbags)
	@touch $@ $(VENV)/.nox $(VENV)/.demo $(VENV)/.demo-fr3 $(VENV)/.demo-learned $(VENV)/.demo-bases $(VENV)/.demo-fleet $(VENV)/.demo-nav $(VENV)/.demo-so101
