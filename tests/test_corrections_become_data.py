"""A person's corrections of a running policy are recorded, exported, and usable for training."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lead_client import LeadPage
from led_cell import INSTRUCTION, STILL, Cell

from rn_recorder_runs.acted import WHO, composed
from rn_recorder_runs.lerobot import export
from rn_recorder_runs.store import RunStore
from rn_standard.teleoperation.executed import displacement
from rn_testing.waiting import wait_until
from roboneuron import Pose

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
ASIDE, TURNED = [0, 0.1, 0.05, 0, 0, 0], [0.05, 0, 0, 0, 0, 0.4]
PERSON = WHO.index("person")
LEADS, RESTS = 3, 3
"""Number of takeovers; rows at the end of a lead in which the arm comes to rest."""
WITHIN_M, WITHIN_RAD = 0.01, 0.05
"""Tolerance for an arm that is held before it has reached its target: a tenth of a second at these
speeds.
"""


def test_what_a_person_did_is_the_action_of_the_rows(
    environment: dict[str, str], tmp_path: Path
) -> None:
    environment["ROBONEURON_RECORDER"] = "on"
    with ExitStack() as stack:
        cell = Cell(environment, tmp_path, stack)
        for module in ("robot", "control", "perception"):
            cell.call(f"start_{module}")
        cell.call("start_recording", name="led")
        cell.call("start_inference", instruction=INSTRUCTION)
        wait_until(lambda: bool(cell.acting), 20.0, poll_s=0.02)
        with LeadPage(cell.url) as page:
            for _ in range(LEADS):
                assert page.lead() == ""
                page.push(STILL, 0.5, held=False)
                page.push(ASIDE, 1.0)
                page.push(TURNED, 1.0)
                page.push(STILL, 1.0, held=False)
                assert page.ask({"back": 1}) == ""
                wait_until(lambda: cell.acting[-1].who == "policy", 20.0, poll_s=0.02)
        cell.call("take_over")  # the page remains the operator for a while after it was closed
        run = cell.call("stop_recording", outcome="success")
        cell.call("stop_all")
    store = RunStore(Path(run["files"][0]).parents[2])
    export([store.get(run["id"])], tmp_path / "set", outcome=None, fps=None, codec="h264")
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet").to_pydict()
    actions = np.array(table["roboneuron.action"])
    poses = [pose_of(values) for values in table["observation.ee_pose"]]
    assert not np.array_equal(actions, table["roboneuron.policy_action"])
    compared = 0
    for led in contiguous(np.array(table["roboneuron.who"]) == PERSON):
        moving = led[np.abs(actions[led, :6]).max(axis=1) > 0]
        if not len(moving) or led[-1] - moving[-1] < RESTS:
            continue
        # on a busy machine samples come too late, and the arm is held in between
        stops = 1 + np.count_nonzero(np.diff(moving) > 1)
        asked = composed(list(actions[moving[0] : led[-1], :6]))
        moved = displacement(poses[moving[0]], poses[led[-1]])
        assert np.linalg.norm(asked[:3] - moved[:3]) < stops * WITHIN_M, (asked, moved)
        assert np.linalg.norm(asked[3:] - moved[3:]) < stops * WITHIN_RAD, (asked, moved)
        compared += np.linalg.norm(moved[:3]) > 0.03
    assert compared, table["roboneuron.who"]


def contiguous(chosen: np.ndarray) -> list[np.ndarray]:
    """Split row numbers into contiguous spans, one array each."""
    numbers = np.flatnonzero(chosen)
    return np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)


def pose_of(values: list[float]) -> Pose:
    """Pose from seven values."""
    return Pose(position_m=np.array(values[:3]), quaternion_xyzw=np.array(values[3:]), stamp_ns=0)
