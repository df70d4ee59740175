"""A SpaceMouse by a device file that refuses, loses and delays its reports."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_standard.teleoperation import spacemouse
from rn_standard.teleoperation.contract_cases import Loopback
from rn_standard.teleoperation.samples import LeadSample
from rn_standard.teleoperation.spacemouse import SpaceMouse, SpaceMouseOptions
from rn_testing.fakes import gantry_profile
from roboneuron import InvalidInputError, NotReadyError


class Device:
    """A device file, and the person at it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        self.mouse = SpaceMouse(SpaceMouseOptions(device=str(path)), gantry_profile())
        self.mouse.open(Loopback())
        self._fd = os.open(path, os.O_WRONLY)

    def send(self, kind: int, *values: int) -> LeadSample:
        """A report of 16-bit numbers, and the sample after it."""
        return self.send_bytes(struct.pack(f"<B{len(values)}h", kind, *values))

    def send_bytes(self, report: bytes) -> LeadSample:
        os.write(self._fd, report)
        return self.read()

    def read(self, timeout_s: float = 0.01) -> LeadSample:
        sample = self.mouse.read(timeout_s)
        assert sample is not None
        return sample

    def unplug(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1


@pytest.fixture
def device(tmp_path: Path) -> Iterator[Device]:
    device = Device(tmp_path / "hidraw0")
    yield device
    device.mouse.close()
    device.unplug()


def test_the_axes_are_those_of_the_person(device: Device) -> None:
    # y of the device points to the person: away from it is forwards
    assert device.send(1, 0, -350, 0).twist.tolist() == pytest.approx([0.25, 0, 0, 0, 0, 0])
    assert device.send(1, -350, 0, 0).twist.tolist() == pytest.approx([0, 0.25, 0, 0, 0, 0])
    assert device.send(1, 0, 0, -350).twist.tolist() == pytest.approx([0, 0, 0.25, 0, 0, 0])
    device.send(1, 0, 0, 0)
    assert device.send(2, 0, 0, -175).twist.tolist() == pytest.approx([0, 0, 0, 0, 0, 0.4])
    assert device.send(2, 0, -350, 0).twist.tolist() == pytest.approx([0, 0, 0, 0.8, 0, 0])


def test_all_six_axes_may_come_in_one_report(device: Device) -> None:
    sample = device.send(1, 0, -350, 0, 0, 0, -350)
    assert sample.twist.tolist() == pytest.approx([0.25, 0, 0, 0, 0, 0.8])


def test_a_push_beyond_the_end_counts_as_full_and_a_touch_as_none(device: Device) -> None:
    assert device.send(1, 0, -32768, 20).twist.tolist() == pytest.approx([0.25, 0, 0, 0, 0, 0])


def test_the_first_button_is_the_switch_and_the_second_the_gripper(device: Device) -> None:
    assert not device.read().is_held
    assert device.send_bytes(b"\x03\x01\x00").is_held
    assert device.send_bytes(b"\x03\x03\x00").gripper_open == 1.0
    assert device.send_bytes(b"\x03\x01\x00").gripper_open == 1.0
    assert device.send_bytes(b"\x03\x02\x00\x00\x00").gripper_open == 0.0
    assert not device.send_bytes(b"\x03\x00\x00").is_held


def test_a_cap_at_rest_is_there_and_a_pushed_one_that_is_silent_is_not(device: Device) -> None:
    resting = device.read()
    assert time.monotonic() - resting.at_s < 0.05
    pushed = device.send(1, 0, -350, 0)
    late = device.read(0.1)
    assert late.number > pushed.number
    assert late.at_s == pushed.at_s


def test_an_unplugged_device_ends_the_lead_and_says_what_to_do(device: Device) -> None:
    device.send(1, 0, -350, 0)
    device.unplug()
    with pytest.raises(NotReadyError, match=r"is gone.*the arm rests.*Plug it in"):
        device.read()


@pytest.mark.parametrize("report", [b"\x01", b"\x01\x00\x00", b"\x02\x00\x00\x00\x00\x00", b"\x03"])
def test_a_report_that_is_too_short_is_none(device: Device, report: bytes) -> None:
    with pytest.raises(InvalidInputError, match="Is this device a SpaceMouse"):
        device.send_bytes(report)


def test_other_reports_are_left_out(device: Device) -> None:
    assert not device.send_bytes(b"\x17\x05\x00").twist.any()


def test_a_device_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    path = tmp_path / "hidraw9"
    mouse = SpaceMouse(SpaceMouseOptions(device=str(path)), gantry_profile())
    with pytest.raises(NotReadyError, match=r"hidraw9 cannot be opened: No such file.*udev"):
        mouse.open(Loopback())
    mouse.close()


def test_the_only_spacemouse_is_found(tmp_path: Path) -> None:
    for number, (vendor, name) in enumerate(
        [("046D", "Logitech USB Mouse"), ("256F", "3Dconnexion SpaceMouse Compact")]
    ):
        folder = tmp_path / f"hidraw{number}" / "device"
        folder.mkdir(parents=True)
        (folder / "uevent").write_text(f"HID_ID=0003:0000{vendor}:0000C635\nHID_NAME={name}\n")
    assert spacemouse._found(tmp_path) == "/dev/hidraw1"
    with pytest.raises(NotReadyError, match="0 SpaceMice"):
        spacemouse._found(tmp_path / "none")
