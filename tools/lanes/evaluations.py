"""Evaluations, training and recording; all can be resumed."""

from __future__ import annotations

import os
import shutil
import sys

import nox

from lanes.environments import ROOT, prepare, python_of
from lanes.lane import BIN, JOBS, lane, python, roboneuron

ACT = """
--steps=1 --save_freq=1 --dataset.repo_id=local/cubes --dataset.root=out/lerobot/data
--policy.type=act --policy.device=cpu --policy.use_amp=true --policy.push_to_hub=false
--policy.pretrained_backbone_weights=null --policy.optimizer_lr_backbone=3e-5
--use_policy_training_preset=false --optimizer.type=adamw --optimizer.lr=3e-4
--optimizer.weight_decay=1e-4 --optimizer.grad_clip_norm=10
--scheduler.type=cosine_annealing_with_warmup --scheduler.num_warmup_steps=100
--policy.dim_model=192 --policy.n_heads=4 --policy.dim_feedforward=768 --policy.n_encoder_layers=2
--policy.use_vae=false --policy.chunk_size=20 --policy.n_action_steps=8
--batch_size=16 --num_workers=0 --log_freq=50 --env_eval_freq=0
"""
"""Options of the first step of `lerobot-train`."""


@lane
def eval_agents(session: nox.Session) -> None:
    """the reference agents in every task, one episode each; resumes (two hours)"""
    subjects = "perfect,tool-only,pointing,without-look,obedient,careless,hostile,random"
    options = ("--subject", subjects, "--retry-errors", *session.posargs)
    roboneuron(session, "eval", "agents", *options)


@lane
def eval_demo(session: nox.Session) -> None:
    """the learned policy on 200 seeds with each FastV preset, then by execution mode and latency"""
    policy = "out/eval/policy"
    shutil.rmtree(ROOT / policy, ignore_errors=True)
    roboneuron(session, "policy", "cubes", "unpack", policy)
    run = ["eval", "run", "--backend", "oft-primary", "--checkpoint", policy]
    run += ["--config", f"{policy}/roboneuron.toml"]
    run += ["--seed", "10000", "--workers", JOBS, "--retry-errors"]
    presets = ("--episodes", "200", "--presets", "none,fastv-p25,fastv-p50,fastv-p75")
    roboneuron(session, *run, *presets, "--out", "out/eval/presets", *session.posargs)
    modes = ["--episodes", "50", "--execution", "sequential,overlap"]
    for latency in ("0", "112ms", "250ms"):
        modes += ["--latency", latency]
    roboneuron(session, *run, *modes, "--out", "out/eval/latency", *session.posargs)
    roboneuron(session, "eval", "report", "out/eval/presets", "--by", "turned_rad=0.2,0.4,0.6")


@lane
def eval_rtc(session: nox.Session) -> None:
    """the flow policy sequential, overlapped and with real-time chunking, by latency; resumes"""
    policy = "out/eval/flow-policy"
    shutil.rmtree(ROOT / policy, ignore_errors=True)
    roboneuron(session, "policy", "cubes", "flow", "unpack", policy)
    run = ["eval", "run", "--backend", "pi0", "--checkpoint", policy]
    run += ["--config", f"{policy}/roboneuron.toml", "--out", "out/eval/rtc"]
    run += ["--seed", "20000", "--episodes", "200", "--workers", JOBS, "--retry-errors"]
    run += ["--execution", "sequential,overlap,rtc"]
    for latency in ("0", "112ms", "250ms", "400ms"):
        run += ["--latency", latency]
    roboneuron(session, *run, *session.posargs)


@lane
def eval_shift(session: nox.Session) -> None:
    """the learned policy on 50 seeds with the camera moved, other light, table or noise"""
    policy = "out/eval/policy"
    shutil.rmtree(ROOT / policy, ignore_errors=True)
    roboneuron(session, "policy", "cubes", "unpack", policy)
    run = ["eval", "run", "--backend", "oft-primary", "--checkpoint", policy]
    run += ["--config", f"{policy}/roboneuron.toml", "--execution", "overlap"]
    run += ["--seed", "10000", "--episodes", "50", "--workers", JOBS, "--retry-errors"]
    for shift in ("none", "camera", "light", "table", "noise"):
        option = ("--suite-option", f"shift={shift}", "--out", f"out/eval/shift/{shift}")
        roboneuron(session, *run, *option, *session.posargs)


@lane
def eval_libero(session: nox.Session) -> None:
    """each of LIBERO's 40 tasks once: no-op, tiny random OpenVLA and OFT (0 % is expected)"""
    prepare(session, "libero")
    out, suites = "out/eval/libero", ("spatial", "object", "goal", "10")
    for name in ("openvla", "oft"):
        tiny = f"{out}/tiny-{name}"
        shutil.rmtree(ROOT / tiny, ignore_errors=True)
        session.run(f"{BIN}/roboneuron-{name}", "make-tiny", tiny)
    torch = ("--option", "torch.device=cpu", "--option", "torch.dtype=float32")
    oft = ("--checkpoint", f"{out}/tiny-oft", "--option", "oft.unnorm_key=tiny", *torch)
    openvla = (
        *("--checkpoint", f"{out}/tiny-openvla", "--option", "openvla.unnorm_key=tiny"),
        *("--option", "openvla.max_outside_share=1", *torch),
    )
    policies: dict[str, tuple[str, ...]] = {"noop": (), "oft": oft, "openvla": openvla}
    for name, options in policies.items():
        for suite in suites:
            command = ("eval", "run", "--suite", f"libero-{suite}", "--backend", name, *options)
            end = ("--retry-errors", "--out", f"{out}/{name}/{suite}")
            roboneuron(session, *command, *end, *(session.posargs or ("--episodes", "10")))
    for name in policies:
        session.log(name)
        folders = [f"{out}/{name}/{suite}" for suite in suites]
        roboneuron(session, "eval", "report", *folders, "--paper-table")


@lane
def improve_cubes(session: nox.Session) -> None:
    """one round for the learned policy: rollouts, training, champion against challenger;
    CORRECTIONS=40: first record so many corrections of a policy whose camera is displaced
    """
    words: list[str] = []
    if wanted := os.environ.get("CORRECTIONS", ""):
        # ARGS are for the training: the recorder would refuse them
        record = "benchmarks/record_corrections.py"
        session.run(sys.executable, record, "--episodes", wanted)
        words += ["--corrections", "out/corrections/data-set"]
        words += ["--suite-option", "displaced_m=[0.06,-0.03,0]"]
    roboneuron(session, "policy", "cubes", "improve", *words, *session.posargs)


@lane
def record_demos(session: nox.Session) -> None:
    """record N demonstrations in simulation, and export them as a LeRobotDataset (out/demos)"""
    python(session, "examples/record_demos.py", "-n", os.environ.get("N", "50"))


@lane
def record_lerobot(session: nox.Session) -> None:
    """lerobot-record of N episodes with the simulated FR3 and a scripted leader
    (out/lerobot/data)
    """
    prepare(session, "lerobot")
    python(session, "examples/record_lerobot.py", "-n", os.environ.get("N", "50"))


@lane
def train_act(session: nox.Session) -> None:
    """lerobot-train of a small ACT on them, on the CPU, ACT_STEPS steps"""
    prepare(session, "lerobot-policies")
    act, theirs = ROOT / "out" / "lerobot" / "act", python_of("lerobot-policies")
    last = act / "checkpoints" / "last" / "pretrained_model"
    # one thread is best while others work; use all cores of a quiet machine
    env = {"OMP_NUM_THREADS": os.environ.get("TRAIN_THREADS", "1"), "HF_HUB_OFFLINE": "1"}
    train = str(theirs.with_name("lerobot-train"))
    if not (act / ".sees").exists():
        # ImageNet's weights would have to be downloaded, so the backbone is pretrained on simulated
        # images
        shutil.rmtree(act, ignore_errors=True)
        session.run(train, *ACT.split(), f"--output_dir={act}", env=env)
        session.run(str(theirs), "examples/pretrain_backbone.py", str(last), env=env)
        (act / ".sees").touch()
    # the learning rate falls to zero at the last step; continuing later starts a second decay
    steps = (f"--steps={os.environ.get('ACT_STEPS', '3000')}", "--save_freq=500")
    resumed = (f"--config_path={last}/train_config.json", "--resume=true")
    session.run(train, *steps, *resumed, *session.posargs, env=env)


@lane
def eval_act(session: nox.Session) -> None:
    """that policy on 100 unseen cube positions (out/eval/act-STEPS)"""
    prepare(session, "lerobot-policies")
    last = ROOT / "out" / "lerobot" / "act" / "checkpoints" / "last"
    options = ["--suite-option", "objects=1", "--suite-option", 'colours=["red"]']
    for option in ("image_px=96", "engine=mujoco", "camera_hz=10", "time_limit_s=10"):
        options += ["--suite-option", option]
    # one folder per checkpoint, named by its steps, because a run evaluates one policy
    out = f"out/eval/act-{last.resolve().name}"
    session.run(
        *(str(python_of("lerobot-policies").with_name("roboneuron")), "eval", "run"),
        *("--config", "examples/lerobot_act.toml", "--backend", "lerobot"),
        *("--checkpoint", str(last / "pretrained_model"), *options),
        *("--episodes", "100", "--seed", "0", "--retry-errors", "--out", out),
        *session.posargs,
    )
