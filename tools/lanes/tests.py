"""Tests beyond the default suite."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import nox

from lanes.environments import CLIENTS, ROOT, folder_of, prepare, python_of
from lanes.lane import BIN, JOBS, lane, pytest, python

OPENPI = Path(os.environ.get("OPENPI", "../openpi"))
"""A checkout of https://github.com/Physical-Intelligence/openpi; 15a9616 produced the numbers in
the docs.
"""
LEROBOT = Path(os.environ.get("LEROBOT", "../lerobot"))
"""A checkout of https://github.com/huggingface/lerobot: 7427f31."""
ROBOARENA = Path(os.environ.get("ROBOARENA", "../roboarena"))
"""A checkout of https://github.com/robo-arena/roboarena."""

UNGUARDED = "--unguarded"
"""For lanes whose tests mount file systems, which the guard of rn_testing.isolation forbids."""


@lane
def test_all(session: nox.Session) -> None:
    """every test for this machine, also exhaustive, timing, slow and release, one at a time"""
    pytest(session, UNGUARDED, "-m", "not gpu and not hardware")


@lane
def test_isa(session: nox.Session) -> None:
    """the models' tests with the instruction set of an old processor, which must not change a
    number
    """
    kinds = ("rn-vla", "rn-runtime-*", "rn-backend-*", "rn-accel-*", "rn-policy-*")
    folders = [str(path) for kind in kinds for path in sorted(ROOT.glob(f"plugins/{kind}/tests"))]
    marks = "not ros and not gpu and not hardware and not slow"
    options = ("-n", JOBS, "--dist", "worksteal", "-m", marks, "-k", "not memory-bounded")
    old = {"ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41"}
    pytest(session, *options, *folders, env=old)


@lane
def test_mutations(session: nox.Session) -> None:
    """mutants of the safety code against its unit tests; resumes: gate --only estop"""
    session.run(
        *(sys.executable, "-m", "pip", "install", "--quiet"),
        *("--constraint", "constraints.txt", "mutmut"),
    )
    python(session, "tools/mutations.py")


@lane
def test_flakes(session: nox.Session) -> None:
    """tests that can fail, run again under several conditions; resumes: --lane ros --minutes 60"""
    python(session, "tools/flakes.py")


@lane
def test_robots(session: nox.Session) -> None:
    """public robots: places, distances, meshes and steps of the controller, judged by other code"""
    session.run(
        *(sys.executable, "-m", "pip", "install", "--quiet"),
        *("--constraint", "constraints.txt", "--no-deps", "example-robot-data"),
    )
    python(session, "benchmarks/robots_sweep.py")


@lane
def test_view(session: nox.Session) -> None:
    """the live view in a headless Chromium (Debian: apt-get install chromium)"""
    pytest(session, "plugins/rn-view/tests")


@lane
def test_link(session: nox.Session) -> None:
    """an encrypted link between two network namespaces: foreign peers, cut cables (needs root)"""
    pytest(session, UNGUARDED, "plugins/rn-link/tests", "-m", "ros")


@lane
def test_serve(session: nox.Session) -> None:
    """robots and policy servers: ten commands on two machines, cut cables, many clients (needs
    root)
    """
    pytest(session, UNGUARDED, "plugins/rn-backend-openpi/tests", "-m", "not ros or slow")


@lane
def test_agents(session: nox.Session) -> None:
    """agents in their benchmark, also several at a time"""
    pytest(session, "plugins/rn-eval/tests/agents", "-m", "ros or slow")


@lane
def test_agents_chat(session: nox.Session) -> None:
    """the chat agent with OpenAI's client library against a scripted server"""
    prepare(session, "openai")
    pytest(session, "plugins/rn-eval/tests/agents/test_a_chat_model_is_an_agent.py")


@lane
def test_eval_kills(session: nox.Session) -> None:
    """50 random kills of an evaluation's workers, command and Ray: no episode lost or repeated"""
    file = "plugins/rn-eval/tests/test_workers_share_a_run.py"
    pytest(session, file, "-s", "-k", "kills_of_workers")


@lane
def test_fr3(session: nox.Session) -> None:
    """the driver of the real arm against franka-sim"""
    prepare(session, "fr3sim")
    pytest(
        session,
        "plugins/rn-robot-fr3/tests/test_fci_driver_moves_franka_sim.py",
        "plugins/rn-robot-fr3/tests/test_fci_driver_behind_a_strict_box.py",
        "tests/safety/test_fci_arm_stops_when_something_is_lost.py",
    )


@lane
def test_sourced(session: nox.Session) -> None:
    """a sourced ROS (Kilted, laid out as /opt/ros, with an overlay workspace): server, modules,
    demo
    """
    prepare(session, "kilted")
    prepare(session, "sourced")
    pytest(session, "-m", "sourced", "tests/sourced")


@lane
def test_peers(session: nox.Session) -> None:
    """nodes of Kilted, Cyclone DDS and announcements of Humble with our server; prints a table"""
    prepare(session, "kilted")
    prepare(session, "cyclone")
    pytest(session, "-m", "peers", "tests/peers")


@lane
def test_libero(session: nox.Session) -> None:
    """states, images and steps of the LIBERO simulator against those of the public scripts"""
    prepare(session, "libero")
    pytest(session, "plugins/rn-eval/tests/libero")


@lane
def test_lerobot(session: nox.Session) -> None:
    """exported data sets, opened by lerobot itself (its own environment)"""
    prepare(session, "lerobot")
    file = "plugins/rn-recorder/tests/test_runs_become_data_sets.py"
    pytest(session, file, "-m", "slow or not slow")


@lane
def test_lerobot_robots(session: nox.Session) -> None:
    """lerobot's own commands with our robots, and our driver with lerobot's"""
    prepare(session, "lerobot")
    prepare(session, "fr3sim")
    folders = ("plugins/lerobot-robot-roboneuron/tests", "plugins/rn-robot-lerobot/tests")
    pytest(session, *folders, "-m", "slow or not slow")


@lane
def test_lerobot_policies(session: nox.Session) -> None:
    """policies of LeRobot against LeRobot's own engines, then through ROS (its own environment)"""
    prepare(session, "lerobot-policies")
    folder = "plugins/rn-backend-lerobot/tests"
    beside = (f"{folder}/policies", f"{folder}/test_lerobot_keeps_its_contract.py")
    session.run(str(python_of("lerobot-policies")), "-m", "pytest", *beside, *session.posargs)
    moved = f"{folder}/test_lerobot_policy_moves_the_arm.py"
    taken_over = "tests/test_an_act_takes_over_from_the_servo.py"
    pytest(session, moved, taken_over, "-m", "slow or not slow")


@lane
def test_openpi_peers(session: nox.Session) -> None:
    """openpi's client and server, and RoboArena's, with ours: OPENPI=path ROBOARENA=path"""
    prepare(session, "openpi-client")
    there = {"ROBONEURON_OPENPI": str(OPENPI), "ROBONEURON_ROBOARENA": str(ROBOARENA)}
    file = "plugins/rn-backend-openpi/tests/test_openpi_public_code_is_on_the_other_end.py"
    pytest(session, "-rs", file, env=there)


@lane
def test_parity(session: nox.Session) -> None:
    """pi0.5 and pi0-FAST against the public code, executed again: OPENPI=path LEROBOT=path"""
    for name, path in {"openpi": OPENPI, "lerobot": LEROBOT}.items():
        if not (path / "src" / name).is_dir():
            session.error(f"{name.upper()}={path} is no checkout of {name}.")
    prepare(session, "openpi")
    prepare(session, "fast")
    out, tests = ROOT / "out" / "parity", "plugins/rn-backend-pi0/tests"
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    tiny = (f"{BIN}/roboneuron-pi0", "make-tiny")
    session.run(
        *tiny, f"{out}/pi05", "--variant", "pi05", "--layout", "openpi", "--profile", "droid"
    )
    session.run(*tiny, f"{out}/fast", "--variant", "pi0_fast", "--profile", "droid")
    for name, checkout, script, numbers in (
        ("openpi", OPENPI, "openpi_numbers", "pi05"),
        ("fast", LEROBOT, "lerobot_fast_numbers", "fast"),
    ):
        command = (str(python_of(name)), f"{tests}/parity/{script}.py", str(checkout))
        session.run(*command, f"{out}/{numbers}", f"{out}/{numbers}.npz")
    pytest(
        session,
        f"{tests}/test_pi05_matches_openpi.py",
        f"{tests}/test_pi0_fast_matches_lerobot.py",
        env={"PI05_NUMBERS": f"{out}/pi05.npz", "PI0_FAST_NUMBERS": f"{out}/fast.npz"},
    )


@lane
def test_conformance(session: nox.Session) -> None:
    """MCP Inspector and the public conformance suite against our server (npm)"""
    python(session, "tests/interop/check.py")


@lane
def aarch64(session: nox.Session) -> None:
    """resolve every distribution for aarch64 and Python 3.12, without installing it"""
    prepare(session, "uv")
    python(session, "tools/aarch64.py", "--uv", str(folder_of("uv") / "bin" / "uv"))


@lane
def test_cancel(session: nox.Session) -> None:
    """the table of cancelled calls: way, transport, protocol, call; base and arm (half an hour)"""
    files = ("tests/test_cancelled_means_stopped.py", "tests/test_a_cancelled_arm_rests.py")
    pytest(session, "-q", "-s", "-m", "slow or not slow", *files)


@lane
def test_frameworks(session: nox.Session) -> None:
    """the MCP clients of public frameworks against our server, each in its own environment"""
    names = session.posargs or list(CLIENTS)
    for name in names:
        prepare(session, f"client-{name}")
    session.run(sys.executable, "tests/interop/frameworks.py", *names)


@lane
def interop_vla_eval(session: nox.Session) -> None:
    """vla-eval 0.8's own client and episode runner against our model server"""
    prepare(session, "vla-eval")
    pytest(session, "plugins/rn-eval/tests/test_backends_are_model_servers.py")


@lane
def interop_sglang(session: nox.Session) -> None:
    """real SGLang in its own environment (3.4 GB): same tokens, latency, closed loop"""
    prepare(session, "sglang")
    theirs = ("--python", str(python_of("sglang")))
    python(session, "plugins/rn-runtime-sglang/interop/check.py", *theirs)
    session.run(sys.executable, "plugins/rn-runtime-sglang/interop/loop.py", *theirs)
