"""Invalid or unintended input to a lead: numbers that are not finite, a flood, an unplugged device,
a full disk.
"""

from __future__ import annotations

import os
import resource
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from lead_client import LeadPage
from led_cell import STILL, Cell
from websockets.exceptions import ConnectionClosed

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing,
    pytest.mark.timeout(240),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
AHEAD = [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
REST_M_S, REST_S, OBSERVED_S = 0.005, 0.2, 0.06
"""As in test_a_person_leads_and_takes_over.py."""
MOVED_M = 0.03
PRESS, PUSH = b"\x03\x01\x00", struct.pack("<B3h", 1, 0, -200, 0)
"""Reports of a SpaceMouse: its first button, and its cap pushed forwards."""


@contextmanager
def served(environment: dict[str, str], tmp_path: Path, more: str = "") -> Iterator[Cell]:
    with ExitStack() as stack:
        cell = Cell(environment, tmp_path, stack, more)
        for module in ("robot", "control"):
            cell.call(f"start_{module}")
        yield cell
        cell.call("take_over")
        cell.call("stop_all")


def check_rests(cell: Cell, since_s: float) -> None:
    """Check that the arm comes to rest in time, until a new start."""
    wait_until(lambda: cell.poses[-1][0] > since_s + 1.2, 10.0, poll_s=0.05)
    assert cell.speed_m_s(since_s + REST_S + OBSERVED_S) < REST_M_S
    assert "the lead was lost" in cell.module("control")["needs_start"]


def pushed(cell: Cell, push: Callable[[], object]) -> None:
    """Push until the arm has moved, because on a busy machine samples may come so late that it
    brakes.
    """
    wait_until(lambda: bool(cell.poses), 10.0)
    for _ in range(8):
        start = cell.poses[-1][1]
        push()
        if abs(cell.poses[-1][1] - start).max() > MOVED_M:
            return
    pytest.fail("the arm does not follow")


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"twist": [float("inf"), 0, 0, 0, 0, 0]}, "no number"),
        ({"twist": [float("-inf"), 0, 0, 0, 0, 0], "tool": True}, "no number"),
        ({"twist": None, "joint": ["fr3_joint1", None]}, "not finite"),
        ({"grip": float("nan")}, "no number"),
        ({"grip": 7.0}, "opening of 7"),
    ],
    ids=["inf", "-inf", "joint-nan", "grip-nan", "grip-7"],
)
def test_a_gamepad_that_gives_no_number_brakes_the_arm(
    environment: dict[str, str], tmp_path: Path, bad: dict[str, object], told: str
) -> None:
    with served(environment, tmp_path) as cell, LeadPage(cell.url) as page:
        assert page.lead() == ""

        def push() -> None:
            page.press()
            page.push(AHEAD, 0.6)

        pushed(cell, push)
        page.send(**{"twist": AHEAD, **bad})  # type: ignore[arg-type]
        check_rests(cell, time.monotonic())
        assert not page.is_led
        assert told in page.text


def test_a_thousand_samples_a_second_end_the_lead(
    environment: dict[str, str], tmp_path: Path
) -> None:
    with served(environment, tmp_path) as cell, LeadPage(cell.url) as page:
        assert page.lead() == ""

        def push() -> None:
            page.press()
            page.push(AHEAD, 0.6)

        pushed(cell, push)
        end_s = time.monotonic() + 5.0
        with suppress(ConnectionClosed):
            while time.monotonic() < end_s:
                page.send(AHEAD)
                time.sleep(0.001)
            pytest.fail("the page may send as much as it likes")
        check_rests(cell, time.monotonic())
        with LeadPage(cell.url) as other:
            assert other.lead() == ""
            other.ask({"back": 1})


def test_a_device_that_is_unplugged_leaves_the_arm_at_rest(
    environment: dict[str, str], tmp_path: Path
) -> None:
    device = tmp_path / "hidraw0"
    os.mkfifo(device)
    more = f'[plugins.spacemouse]\ndevice = "{device}"\n'
    with served(environment, tmp_path, more) as cell:
        plug = os.open(device, os.O_RDWR)
        cell.call("lead_arm", source="spacemouse")

        def push() -> None:
            os.write(plug, b"\x03\x00\x00")
            time.sleep(0.1)
            os.write(plug, PRESS)
            end_s = time.monotonic() + 0.6
            while time.monotonic() < end_s:
                os.write(plug, PUSH)
                time.sleep(0.01)

        pushed(cell, push)
        os.close(plug)  # no other process has it open for writing, so its reader gets the end
        check_rests(cell, time.monotonic())
        assert "Nobody leads" in cell.refusal("hand_back")


def test_a_disk_that_is_full_ends_neither_the_lead_nor_the_switch(
    environment: dict[str, str], tmp_path: Path
) -> None:
    environment["ROBONEURON_RECORDER"] = "on"
    with served(environment, tmp_path) as cell, LeadPage(cell.url) as page:
        run = cell.call("start_recording", name="led")
        assert page.lead() == ""

        def push() -> None:
            page.press()
            page.push(AHEAD, 0.6)

        pushed(cell, push)
        fill_disk(Path(run["directory"]))
        page.push(STILL, 0.1, held=False)
        wait_until(lambda: bool(cell.call("list_recordings")["problem"]), 30.0, poll_s=0.1)
        up = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]

        def lift() -> None:
            page.press()
            page.push(up, 0.6)

        pushed(cell, lift)
        page.send(up, held=False)
        released_s = time.monotonic()
        page.push(STILL, 1.0, held=False)
        assert cell.speed_m_s(released_s + REST_S + OBSERVED_S) < REST_M_S
        assert page.is_led
        assert page.ask({"back": 1}) == ""
        assert cell.call("list_recordings")["lost"] > 0


def fill_disk(directory: Path) -> None:
    """Prevent the recorder's files from growing, as on a full disk."""
    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            opened = [file.path for file in process.open_files()]
            if any(Path(path).is_relative_to(directory) for path in opened):
                size = max(path.stat().st_size for path in directory.iterdir())
                _, hard = resource.prlimit(process.pid, resource.RLIMIT_FSIZE)
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, hard))
                return
    pytest.fail("no process writes there")
