# Every target sets up what it needs in .venv; nothing else has to be installed but Python >= 3.11 and make.
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

DEMO_PACKAGES := roboneuron-core plugins/rn-robot-fr3 plugins/rn-controller-urdf plugins/rn-backend-servo \
  plugins/rn-demo plugins/rn-console plugins/rn-fastdds plugins/rn-ops plugins/rn-switching plugins/rn-tools-ros \
  plugins/rn-tools-arm plugins/rn-tools-inspect
ALL_PACKAGES := roboneuron-core $(sort $(wildcard plugins/rn-*))
# These compile ROS 2 types and need a C++ compiler; without one the rest works, and their tests are skipped.
COMPILED := plugins/rn-interfaces-control plugins/rn-driver-ros2control
comma := ,
WITH_EXTRAS := $(patsubst %/rn-backend-pi0,'%/rn-backend-pi0[native$(comma)remote]',\
  $(patsubst %/rn-perception-camera,'%/rn-perception-camera[video]',\
  $(patsubst %/rn-eval,'%/rn-eval[ray]',$(filter-out $(COMPILED),$(ALL_PACKAGES)))))
SOURCES := $(wildcard $(addsuffix /src,$(ALL_PACKAGES)))
PROJECTS := $(addsuffix /pyproject.toml,$(ALL_PACKAGES)) constraints.txt

.PHONY: help demo demo-fr3 demo-bases eval-demo test-fr3 bench-fci bench-fci-loop test test-units test-ros test-all test-pythons check format bench soak bench-vla interop interop-sglang docs clean

help: ## show this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

demo: $(VENV)/.demo ## an agent picks up a cube with a simulated FR3
	@$(BIN)/roboneuron demo $(ARGS)

demo-fr3: $(VENV)/.demo-fr3 .venv-fr3sim/.ready ## the same with the driver of the real arm, against franka-sim (its own environment)
	@$(BIN)/python examples/demo_fr3.py $(ARGS)

test-fr3: $(VENV)/.develop .venv-fr3sim/.ready ## the driver of the real arm against franka-sim
	$(BIN)/python -m pytest plugins/rn-robot-fr3/tests/test_fci_driver_moves_franka_sim.py \
	  tests/safety/test_fci_arm_stops_when_something_is_lost.py $(ARGS)

bench-fci: $(VENV)/.develop .venv-fr3sim/.ready ## accuracy, stopping and load of that driver; prints the tables of docs/fr3.md
	$(BIN)/python benchmarks/bench_fci.py $(ARGS)

bench-fci-loop: $(VENV)/.develop .venv-fr3sim/.ready ## a policy with warm switches, random actions, emergency stops: --minutes 30 --actions 10000
	$(BIN)/python benchmarks/bench_fci_stops.py
	$(BIN)/python benchmarks/bench_fci_loop.py $(ARGS)

.venv-fr3sim: .venv-fr3sim/.ready

.venv-fr3sim/.ready:
	@echo "Setting up .venv-fr3sim (once, about a minute) ..."
	$(PYTHON) -m venv .venv-fr3sim
	.venv-fr3sim/bin/python -m pip install --quiet --disable-pip-version-check franka-sim==1.1.7 numpy==1.26.4
	@touch $@

eval-demo: $(VENV)/.develop ## the servo policy on 200 seeds, then by execution mode and latency: ledger, table, report
	@echo "No learned policy is in the repository: this measures the classical policy 'servo', which has no pruning presets."
	$(BIN)/roboneuron eval run --backend servo --episodes 200 --seed 10000 --workers $(JOBS) --out out/eval/servo $(ARGS)
	$(BIN)/roboneuron eval run --backend servo --episodes 50 --seed 10000 --workers $(JOBS) --out out/eval/servo-latency \
	  --execution sequential,overlap --latency 0 --latency 112ms --latency 250ms $(ARGS)

demo-bases: $(VENV)/.demo-bases ## an MCP client drives three mobile bases with one velocity tool
	@$(BIN)/python examples/drive_bases.py $(ARGS)

test: test-units test-ros ## the default test suite

test-units: $(VENV)/.develop ## its tests without ROS processes, JOBS at a time
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not ros and not gpu and not hardware and not slow" $(ARGS)

test-ros: $(VENV)/.develop ## its tests with ROS processes, JOBS at a time, then those that keep time, alone
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder \
	  -m "ros and not timing and not gpu and not hardware and not slow" $(ARGS)
	$(BIN)/python -m pytest -m "ros and timing and not gpu and not hardware and not slow" $(ARGS)

test-all: $(VENV)/.develop ## the default suite and the slow tests
	$(BIN)/python -m pytest -m "not gpu and not hardware" $(ARGS)

test-pythons: ## demo and bases on each of PYTHONS, in a fresh environment: what a new user gets
	$(PYTHON) tests/pythons/check.py $(PYTHONS)

check: $(VENV)/.develop ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy $(SOURCES)

format: $(VENV)/.develop ## put the code into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.develop ## every benchmark of the closed loop; prints the tables of docs/benchmarks.md
	$(BIN)/python benchmarks/bench_plugins_list.py
	$(BIN)/python benchmarks/bench_ik.py
	$(BIN)/python benchmarks/bench_loop.py
	$(BIN)/python benchmarks/bench_execution.py --virtual
	$(BIN)/python benchmarks/bench_execution.py
	$(BIN)/python benchmarks/bench_start_stop.py
	$(BIN)/python benchmarks/bench_round_trip.py
	$(BIN)/python benchmarks/bench_switch.py
	$(BIN)/python benchmarks/bench_faults.py
	$(BIN)/python benchmarks/bench_direct.py
	$(BIN)/python benchmarks/bench_servo.py
	$(BIN)/python benchmarks/bench_servo.py --added-latency-ms 300
	$(BIN)/python benchmarks/bench_eval.py
	$(BIN)/python benchmarks/bench_interfaces.py

soak: $(VENV)/.develop ## the loop for 30 minutes with switches and random faults: nothing grows, everything recovers
	$(BIN)/python benchmarks/soak.py $(ARGS)

bench-vla: $(VENV)/.develop ## backends and acceleration presets beside a plain transformers loop
	$(BIN)/python benchmarks/bench_vla.py $(ARGS)

interop: $(VENV)/.develop ## MCP Inspector and the public conformance suite against our server (npm)
	$(BIN)/python tests/interop/check.py $(ARGS)

interop-sglang: $(VENV)/.develop .venv-sglang/.ready ## real SGLang in an environment of its own (3.4 GB): same tokens, latency, closed loop
	$(BIN)/python plugins/rn-runtime-sglang/interop/check.py --python .venv-sglang/bin/python $(ARGS)
	$(BIN)/python plugins/rn-runtime-sglang/interop/loop.py --python .venv-sglang/bin/python

.venv-sglang/.ready: plugins/rn-runtime-sglang/interop/install.sh plugins/rn-runtime-sglang/interop/requirements.txt
	@echo "Setting up .venv-sglang (once, about five minutes) ..."
	plugins/rn-runtime-sglang/interop/install.sh .venv-sglang $(PYTHON)
	@touch $@

docs: $(VENV)/.docs ## build the documentation site into out/site; every link and anchor is checked
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python tools/check_site.py out/site

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
	$(call install,client of the FCI,--constraint constraints.txt franky-control)
	@touch $@

$(VENV)/.demo-bases: $(PROJECTS) | $(BIN)/python
	@echo "Setting up $(VENV) for the bases:"
	$(call install,core$(comma) ROS 2 and MCP,--constraint constraints.txt --editable roboneuron-core)
	$(call install,simulated bases,--constraint constraints.txt --editable plugins/rn-robot-bases --editable plugins/rn-tools-ros)
	@touch $@

$(VENV)/.docs: constraints.txt | $(BIN)/python
	$(PIP) --constraint constraints.txt mkdocs-material 'mkdocstrings[python]'
	@touch $@

# torch first and by itself: with anything else on the line pip may pick a build with gigabytes of CUDA packages.
$(VENV)/.develop: $(PROJECTS) pyproject.toml | $(BIN)/python
	@echo "Setting up $(VENV) with every plugin and the development tools (once, about four minutes):"
	$(call install,PyTorch,torch==2.13.0)
	$(call install,core$(comma) ROS 2 and MCP,--constraint constraints.txt --editable roboneuron-core)
	$(call install,every plugin,--constraint constraints.txt $(addprefix --editable ,$(WITH_EXTRAS)))
	-$(call install,types of ros2_control (compiled),--constraint constraints.txt $(addprefix --editable ,$(COMPILED)))
	$(call install,tools for tests and checks,--constraint constraints.txt \
	  pytest pytest-timeout pytest-xdist hypothesis ruff mypy types-psutil jsonschema types-jsonschema psutil build hatchling editables \
	  ros-jazzy-test-msgs transformers mujoco franky-control)
	@touch $@ $(VENV)/.demo $(VENV)/.demo-fr3 $(VENV)/.demo-bases
