"""Leaders other than a program: a person at the live view's sliders, lerobot's own leader arm, and
another robot of RoboNeuron.
"""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from anyio.from_thread import start_blocking_portal
from lerobot_lane import JOINTS, PATIENT, Lerobot, Served, Watch
from page_client import PageClient

from rn_robot_lerobot.bus.arm import SerialArm
from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_robot_lerobot.simulation import CELL
from rn_testing.waiting import wait_until

ACTION_TIMEOUT_S, BRAKING_S = 0.5, 0.3
"""Of control; what the simulated arm needs beyond it on a busy machine."""
END_S = 200.0
_HAND_S = 0.02
SWITCH = "Lead with these sliders"
VIEW = re.compile(r"live view is at (http://[\d.]+:\d+)")
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture
def view(
    config: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> Iterator[tuple[str, Callable[[], PageClient]]]:
    """Address of a served view, and a function that opens a page with which a person leads."""
    config.write_text(config.read_text(encoding="utf-8") + "\n[view]\nenabled = true\nport = 0\n")
    request.getfixturevalue("served")
    log = tmp_path / "server.log"
    wait_until(lambda: VIEW.search(log.read_text()) is not None, 20.0, "the view")
    found = VIEW.search(log.read_text())
    assert found is not None
    url, pages = found.group(1), list[PageClient]()

    def lead() -> PageClient:
        page = PageClient(url)
        pages.append(page)
        wait_until(lambda: SWITCH in page.labels, 30.0, "the sliders")
        # joints come with the next state
        wait_until(lambda: "shoulder_pan" in page.text, 30.0, "the joints")
        page.choose(SWITCH, True)
        return page

    yield url, lead
    for page in pages:
        page.close()


def follow(lerobot: Lerobot, url: str) -> subprocess.Popen[str]:
    return lerobot.teleoperate(f"--teleop.view={url}")


def pan_deg(watch: Watch) -> float:
    return float(np.degrees(watch.seen[-1][1][0]))


def test_a_person_leads_the_arm_with_the_sliders_of_the_live_view(
    lerobot: Lerobot, view: tuple[str, Callable[[], PageClient]], watch: Watch
) -> None:
    url, lead = view
    page = lead()
    begun_s = time.monotonic()
    process = follow(lerobot, url)
    page.choose("shoulder_pan [deg]", 30.0)
    wait_until(lambda: pan_deg(watch) > 29.0 or process.poll() is not None, END_S, "30 degrees")
    assert process.poll() is None, lerobot.last_line(process)
    others = np.degrees(np.ptp(watch.since(begun_s)[:, 1:], axis=0))
    assert others.max() < 1.0
    # a slider jumps, but the arm does not: a quarter of its 3 rad/s, with a margin for timing
    rows = watch.since(begun_s)
    times = np.array([at_s for at_s, _ in watch.seen if at_s >= begun_s])
    first, last = np.searchsorted(np.degrees(rows[:, 0]), [10.0, 25.0])
    assert np.radians(15.0) / (times[last] - times[first]) < 1.0

    page.choose("shoulder_pan [deg]", -60.0)
    wait_until(lambda: pan_deg(watch) < 0.0, 20.0, "the way back")
    begun_s = time.monotonic()
    page.close()
    after_s = watch.rest_after_s(begun_s)
    print(f"at rest {after_s:.2f} s after the page was closed")
    assert after_s < ACTION_TIMEOUT_S + 0.5 + BRAKING_S
    assert pan_deg(watch) > -50.0
    assert process.wait(END_S) != 0
    told = lerobot.last_line(process)
    assert f"The leader on the page {url} has been silent for" in told
    assert "No page leads this robot." in told


def test_a_view_that_is_not_there_and_another_robot_are_named(
    lerobot: Lerobot, view: tuple[str, Callable[[], PageClient]]
) -> None:
    url, lead = view
    lead()
    nowhere = lerobot.teleoperate("--teleop.view=http://127.0.0.1:9", "--teleop.start_timeout_s=3")
    assert nowhere.wait(END_S) != 0
    assert "The view does not answer: [Errno 111]" in lerobot.last_line(nowhere)
    other = lerobot.teleoperate(f"--teleop.view={url}", "--teleop.namespace=fr3")
    assert other.wait(END_S) != 0
    assert "There is no robot 'fr3'; this view shows so101" in lerobot.last_line(other)


class HandMovedArm(SerialArm):
    """The motors of a leader arm, whose first joint is turned by hand; without physics.

    Attributes:
        wanted_rad: position to which it is turned [rad], at 0.2 rad/s.
    """

    wanted_rad = 0.0

    def _move(self) -> None:
        position, still = CELL.start.copy(), np.zeros(len(CELL.start))
        while not self._ending.wait(_HAND_S):
            step = 0.2 * _HAND_S
            position[0] += float(np.clip(self.wanted_rad - position[0], -step, step))
            with self._lock:
                self.motors.measure(position, still)
            self.history.append((time.monotonic(), position.copy()))


def test_lerobots_own_leader_arm_leads(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    """Its class, motors behind a serial port, and a hand that moves the arm without torque."""
    calibration = ASSEMBLED_SO101.calibration()
    text = json.dumps({name: asdict(motor) for name, motor in calibration.items()})
    (tmp_path / "hand.json").write_text(text, encoding="utf-8")
    with HandMovedArm() as leader:
        process = lerobot.start(
            "lerobot-teleoperate",
            "--robot.type=roboneuron",
            "--robot.robot=so101",
            *PATIENT,
            "--teleop.type=so101_leader",
            f"--teleop.port={leader.port}",
            "--teleop.id=hand",
            f"--teleop.calibration_dir={tmp_path}",
            "--fps=30",
        )
        wait_until(
            lambda: "Teleop loop time" in lerobot.told(process) or process.poll() is not None,
            END_S,
            "the loop",
        )
        assert process.poll() is None, lerobot.last_line(process)
        leader.wanted_rad = 0.3
        wait_until(lambda: abs(pan_deg(watch) - np.degrees(0.3)) < 2.0, 20.0, "the arm to follow")
        begun_s = time.monotonic()
        leader.motors.faults = type(leader.motors.faults)(silent=True)
        assert watch.rest_after_s(begun_s) < 2 * ACTION_TIMEOUT_S + BRAKING_S
        assert process.wait(END_S) != 0


def test_another_robot_of_roboneuron_leads(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    config = tmp_path / "leader.toml"
    config.write_text(
        '[robot]\nname = "so101"\ndriver = "simulated"\nnamespace = "leading_arm"\n'
        '[control]\ncontroller = "urdf"\n'
        f'[supervisor]\nstate_directory = "{tmp_path / "other"}"\n',
        encoding="utf-8",
    )
    with ExitStack() as stack:
        portal = stack.enter_context(start_blocking_portal())
        leader = Served(portal, config, tmp_path / "leader.log")
        stack.callback(leader.close)
        for module in ("robot", "control"):
            leader.call(f"start_{module}")
        leading = Watch("leading_arm", JOINTS)
        stack.callback(leading.close)
        process = lerobot.teleoperate("--teleop.topic=/leading_arm/joint_states")
        wait_until(
            lambda: "Teleop loop time" in lerobot.told(process) or process.poll() is not None,
            END_S,
            "the loop",
        )
        assert process.poll() is None, lerobot.last_line(process)
        leader.call("move_joints", positions={"shoulder_pan": 0.4, "wrist_roll": -0.3})
        wait_until(
            lambda: (
                np.abs(watch.seen[-1][1] - leading.seen[-1][1]).max() < 0.03
                and abs(watch.seen[-1][1][0] - 0.4) < 0.03
            ),
            20.0,
            "both to be alike",
        )
        leader.call("stop_robot")
        assert process.wait(END_S) != 0
        assert "The leader on /leading_arm/joint_states has been silent" in lerobot.last_line(
            process
        )
