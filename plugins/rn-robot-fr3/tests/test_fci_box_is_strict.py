"""The test control box refuses, drops and checks by the published rules; without franka-sim."""

from __future__ import annotations

import struct

import pytest
from fci_box import services, wire
from fci_box.judge import CommandJudge
from fci_box.network import Cable, Faults
from fci_box.wire import Service

from rn_robot_fr3.fci.addresses import free_address
from rn_robot_fr3.profile import HOME_RAD

THRESHOLDS = struct.pack("<52d", *[20.0] * 28, *[30.0] * 24)
HOME = list(HOME_RAD)


def refused(
    service: int, payload: bytes = b"", mode: int = wire.IDLE, is_latched: bool = False
) -> int:
    answer = services.refusal(service, payload, mode, is_latched)
    return answer[0] if answer else 0


@pytest.mark.parametrize(
    "mode", [wire.OTHER, wire.MOVE, wire.GUIDING, wire.REFLEX, wire.USER_STOPPED]
)
def test_settings_and_motions_are_refused_unless_the_arm_is_idle(mode: int) -> None:
    assert refused(Service.SET_COLLISION_BEHAVIOR, THRESHOLDS, mode) == wire.NOT_POSSIBLE
    assert refused(Service.MOVE, bytes(56), mode) == wire.MOVE_NOT_POSSIBLE
    assert refused(Service.SET_COLLISION_BEHAVIOR, THRESHOLDS) == 0
    assert refused(Service.MOVE, bytes(56)) == 0


def test_a_latched_box_takes_settings_only_after_a_recovery() -> None:
    assert (
        refused(Service.SET_LOAD, struct.pack("<13d", *[0.0] * 13), is_latched=True)
        == wire.NOT_POSSIBLE
    )
    assert refused(Service.AUTOMATIC_ERROR_RECOVERY, is_latched=True) == 0
    assert refused(Service.AUTOMATIC_ERROR_RECOVERY, mode=wire.REFLEX) == 0
    assert refused(Service.AUTOMATIC_ERROR_RECOVERY, mode=wire.USER_STOPPED) == wire.NOT_POSSIBLE


@pytest.mark.parametrize(
    ("service", "values"),
    [
        (Service.SET_COLLISION_BEHAVIOR, [0.0] * 52),
        (Service.SET_COLLISION_BEHAVIOR, [float("nan")] * 52),
        (Service.SET_COLLISION_BEHAVIOR, [20.0] * 7 + [10.0] * 45),
        (Service.SET_COLLISION_BEHAVIOR, [20.0] * 51),
        (Service.SET_LOAD, [-1.0] + [0.0] * 12),
        (Service.SET_LOAD, [1.0, 0, 0, 0, 1, 2, 0, 0, 1, 0, 0, 0, 1]),
    ],
)
def test_settings_without_sense_are_refused(service: int, values: list[float]) -> None:
    assert refused(service, struct.pack(f"<{len(values)}d", *values)) == wire.INVALID_ARGUMENT


def judged(*steps: float) -> CommandJudge:
    """Judge a first joint at these offsets [rad] from home, by cycle; None is a cycle without a
    command.
    """
    judge = CommandJudge()
    judge.begin(list(HOME))
    for step in steps:
        judge.take([HOME[0] + step, *HOME[1:]])
    return judge


def test_a_command_beyond_jerk_or_acceleration_is_counted_and_named() -> None:
    # 4.9 rad/s2 within a millisecond: 4900 rad/s3
    assert judged(4.9e-6, 14.7e-6).report()["violations"] == 0
    sharp = judged(5.1e-6)
    assert "jerk of joint 1 is 1.020" in sharp.beyond[0]
    hard = judged(4.9e-6, 14.7e-6, 36.0e-6).report()
    assert any("acceleration of joint 1" in text for text in hard["beyond"])


def test_a_command_that_forgets_the_cycles_that_were_missed_is_beyond_the_limits() -> None:
    judge = judged(*(1e-6 * n * (n + 1) / 2 for n in range(1, 101)))  # 1 rad/s2
    assert judge.counts["violations"] == 0
    here = judge.arm.position if judge.arm else []
    for _ in range(5):
        judge.miss()
    judge.take([here[0] + 1e-4, *here[1:]])
    assert judge.counts["violations"] > 0
    assert judge.counts["longest_gap"] == 5


def test_a_cable_loses_doubles_delays_and_swaps_by_its_seed() -> None:
    cable = Cable(seed=3)
    cable.faults = Faults(loss=0.1, duplicate=0.1, reorder=0.1, delay=0.1)
    arrived: list[int] = []
    for number in range(1000):
        cable.put(number.to_bytes(2, "big"), number / 1000.0)
        arrived += [int.from_bytes(datagram, "big") for datagram in cable.arrived(number / 1000.0)]
    assert 830 < len(set(arrived)) < 970
    assert len(arrived) > len(set(arrived)) + 50
    assert arrived != sorted(arrived)


def test_two_simulators_get_addresses_of_their_own() -> None:
    found = {free_address(1337, 1338, 1339) for _ in range(4)}
    assert len(found) == 4
    assert all(address.startswith("127.") for address in found)
