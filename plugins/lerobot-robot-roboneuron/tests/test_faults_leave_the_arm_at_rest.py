"""Faults that end lerobot's part: one error sentence, the arm at rest within the bounds of the
fault matrix, and no motion without a new start.
"""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import pytest
from lerobot_lane import Lerobot, Served, Watch, release_stop

from rn_testing.waiting import wait_until

ACTION_TIMEOUT_S, BRAKING_S = 0.5, 0.3
"""Control's timeout; the simulated arm's braking time on a busy machine."""
END_S = 200.0
"""Bound on a command of lerobot: importing it takes 6 s of a core, and more on a busy machine."""


def led(lerobot: Lerobot, watch: Watch) -> subprocess.Popen[str]:
    """Let lerobot move the arm after a leader."""
    lerobot.lead()
    process = lerobot.teleoperate()
    wait_until(lambda: watch.is_moving() or process.poll() is not None, END_S, "the arm to be led")
    assert process.poll() is None, lerobot.last_line(process)
    return process


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "frozen"])
def test_a_lost_lerobot_leaves_an_arm_at_rest(
    lerobot: Lerobot, served: Served, watch: Watch, blow: signal.Signals
) -> None:
    process = led(lerobot, watch)
    begun_s = time.monotonic()
    process.send_signal(blow)
    after_s = watch.rest_after_s(begun_s)
    print(f"at rest {after_s:.2f} s after lerobot was {blow.name}")
    assert after_s < ACTION_TIMEOUT_S + BRAKING_S
    if blow == signal.SIGSTOP:
        process.kill()


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_after_an_emergency_stop_nothing_moves_without_a_new_start(
    lerobot: Lerobot, served: Served, watch: Watch, tmp_path: Path
) -> None:
    process = led(lerobot, watch)
    begun_s = time.monotonic()
    served.call("emergency_stop")
    after_s = watch.rest_after_s(begun_s)
    print(f"at rest {after_s:.2f} s after the emergency stop")
    assert after_s < ACTION_TIMEOUT_S + BRAKING_S
    assert process.wait(END_S) != 0
    assert "The emergency stop was triggered: the arm holds" in lerobot.last_line(process)

    latched = lerobot.teleoperate()
    assert latched.wait(END_S) != 0
    assert "The emergency stop is latched" in lerobot.last_line(latched)

    release_stop(tmp_path / "state" / "roboneuron")
    released_s = time.monotonic()
    refused = lerobot.teleoperate()
    assert refused.wait(END_S) != 0
    assert "Motion needs a new start after a stop" in lerobot.last_line(refused)
    assert watch.rest_after_s(released_s) == 0.0

    served.call("move_joints", positions={"shoulder_pan": 0.0})
    again = lerobot.teleoperate("--teleop_time_s=3")
    wait_until(lambda: watch.is_moving() or again.poll() is not None, END_S)
    assert again.wait(END_S) == 0, lerobot.last_line(again)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_silent_leader_ends_it_with_the_arm_at_rest(
    lerobot: Lerobot, served: Served, watch: Watch
) -> None:
    leader = lerobot.lead()
    process = lerobot.teleoperate()
    wait_until(watch.is_moving, END_S, "the arm to be led")
    begun_s = time.monotonic()
    leader.kill()
    assert watch.rest_after_s(begun_s) < 2 * ACTION_TIMEOUT_S + BRAKING_S
    assert process.wait(END_S) != 0
    assert "The leader on /leader/joint_states has been silent for" in lerobot.last_line(process)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_camera_that_was_renamed_or_is_not_sent_is_refused_by_name(
    lerobot: Lerobot, config: Path, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    text = config.read_text(encoding="utf-8")
    section = '[perception]\nsource = "so101-sim-camera"\n'
    assert section in text
    config.write_text(text.replace(section, section + 'cameras = ["front"]\n'), encoding="utf-8")
    request.getfixturevalue("served")
    renamed = lerobot.teleoperate("--robot.images={overhead: front}")
    absent = lerobot.teleoperate("--robot.start_timeout_s=8")
    assert renamed.wait(END_S) != 0
    assert "Robot 'so101' has no camera 'overhead'; it has front, wrist" in lerobot.told(renamed)
    assert absent.wait(END_S) != 0
    assert "Images of camera 'wrist' did not come within 8 s" in lerobot.last_line(absent)
    assert "there are the cameras front;" in lerobot.last_line(absent)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_do_not_lead_one_arm(lerobot: Lerobot, served: Served, watch: Watch) -> None:
    first = led(lerobot, watch)
    second = lerobot.teleoperate()
    # if the first one has ended, because its leader stopped publishing, the second one gets the arm
    wait_until(lambda: second.poll() is not None or first.poll() is not None, END_S)
    assert second.poll(), lerobot.last_line(first)
    assert "lerobot_robot sends actions to this robot" in lerobot.last_line(second)
