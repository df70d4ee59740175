"""Recorded actions in a simulation: what was recorded is done again, and what no client might send
is refused.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from rclpy.serialization import serialize_message

from rn_recorder.playing import PlayRecording, action_message, pace, pieces, playing_tool
from rn_recorder_runs.against_robot import play
from rn_recorder_runs.files import Record, RunFile
from roboneuron import ConfigurationError, RefusedError, StateError
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.server.app import Application

STEP_M, STEPS = 0.004, 12


def record(path: Path, *steps_m: float) -> Path:
    """A run of actions along y, ten a second, and of the poses that they led to."""
    from geometry_msgs.msg import PoseStamped

    file = RunFile(path, {"robot": "gantry"})
    y_m = 0.0
    for number, step_m in enumerate(steps_m):
        at_ns = (number + 1) * 100_000_000
        pose = PoseStamped()
        pose.pose.position.y = y_m
        data = bytes(serialize_message(pose))
        file.write(
            Record(
                "/gantry/ee_pose", "geometry_msgs/msg/PoseStamped", at_ns, at_ns, number + 1, data
            )
        )
        message = action_message(np.array([0.0, step_m, 0.0, 0.0, 0.0, 0.0, 1.0]))
        data = bytes(serialize_message(message))
        file.write(
            Record(
                "/gantry/action", "std_msgs/msg/Float64MultiArray", at_ns, at_ns, number + 1, data
            )
        )
        y_m += step_m
    file.finish()
    return path


@pytest.mark.exhaustive
@pytest.mark.ros
@pytest.mark.timeout(240)
def test_recorded_actions_move_the_simulation(
    config_path: Path,
    server_environment: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in server_environment.items():
        monkeypatch.setenv(name, value)
    played = play([record(tmp_path / "good.mcap", *[STEP_M] * STEPS)], config_path)
    assert played.sent == STEPS
    assert played.path_m == pytest.approx(STEP_M * (STEPS - 1))
    assert played.end_m is not None
    assert played.end_m < played.path_m  # it moved there; how far depends on the machine's load
    lines = [
        json.loads(line) for line in (tmp_path / "state" / "audit.jsonl").read_text().splitlines()
    ]
    found = [line["verdict"] for line in lines if line["tool"] == "play_recording"]
    assert found == ["would_allow", "allowed"]
    assert os.environ["ROBONEURON_RECORDER"] == "on"


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    control = '[control]\ncontroller = "gantry"\n'
    return application_of(DIRECT_PATH, text=f'[robot]\nname = "gantry"\n{control}')


class Caller:
    """Context of a call by an operator, on the test's own thread."""

    who, role, simulated = "somebody", "operator", False

    async def run(self, work: Callable[[Callable[[str], None]], Any], **rest: Any) -> Any:
        """Do it at once."""
        return work(lambda _: None)


def play_here(application: Application, path: Path) -> Any:
    tool = playing_tool(application.host)
    return anyio.run(tool.handler, PlayRecording(files=[str(path)]), Caller())


@pytest.mark.parametrize(("bad", "rule"), [(1.5, "bounds"), (math.nan, "finite")])
def test_an_action_that_the_gate_refuses_is_not_played(
    application: Application, tmp_path: Path, bad: float, rule: str
) -> None:
    """Nothing of the run is sent, although the action is its last one."""
    with pytest.raises(RefusedError, match=r"nothing was sent.*data\[1\]"):
        play_here(application, record(tmp_path / "bad.mcap", STEP_M, STEP_M, bad))
    lines = [json.loads(line) for line in application.host.audit.path.read_text().splitlines()]
    assert (lines[-1]["verdict"], lines[-1]["rule"]) == ("would_refuse", rule)
    with pytest.raises(StateError, match="control"):  # what the gate allows waits for control
        play_here(application, record(tmp_path / "good.mcap", STEP_M, STEP_M))


def test_only_simulations_play_recordings(tmp_path: Path) -> None:
    config = tmp_path / "real.toml"
    config.write_text('[robot]\nname = "fr3"\ndriver = "fci"\n[plugins.fr3]\n')
    with pytest.raises(ConfigurationError, match="simulation only"):
        play([tmp_path / "any.mcap"], config)


def test_actions_keep_their_pace_unless_the_gate_takes_fewer() -> None:
    tenth_ns = 100_000_000
    assert pace([0, tenth_ns, 3 * tenth_ns], 20.0) == pytest.approx([0.0, 0.1, 0.3])
    # nobody waits for a pause
    assert pace([0, 60 * 10**9, 61 * 10**9], 20.0) == pytest.approx([0.0, 1.0, 2.0])
    fast = pace([number * 10_000_000 for number in range(100)], 20.0)
    assert all(later - now >= 1.0 for now, later in zip(fast, fast[20:], strict=False))


def test_long_recordings_are_several_motions() -> None:
    due_s = [0.5 * number for number in range(10)]
    found = list(pieces(due_s, 1.0))
    assert [index for piece in found for index in piece] == list(range(10))
    assert [len(piece) for piece in found] == [3, 3, 3, 1]
