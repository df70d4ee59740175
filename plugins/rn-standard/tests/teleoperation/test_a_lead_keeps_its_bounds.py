"""A lead by a virtual clock: what it asks for, when it rests, and what ends it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_standard.teleoperation.rows import LeadRow
from rn_standard.teleoperation.samples import LeadSample
from rn_standard.teleoperation.session import (
    GONE_S,
    LATE_S,
    LATEST_S,
    SILENT_S,
    LeadSession,
    LeadSpeeds,
)
from rn_testing.fakes import gantry_profile
from roboneuron import InvalidInputError, NotReadyError, RobotProfile, UnsafeError

PROFILE = gantry_profile()
JOINTS = PROFILE.arm_joints
AT_ZERO = dict.fromkeys(JOINTS, 0.0)
AHEAD = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])


class Person:
    """Acts by a clock of the test."""

    def __init__(self, mode: str = "person", scale: float = 1.0) -> None:
        self.now_s = 100.0
        self.number = 0
        self.session = LeadSession(
            "one",
            mode,
            PROFILE,
            LeadSpeeds(),
            self.now_s,
            scale=scale,  # type: ignore[arg-type]
        )

    def sample(self, *, held: bool = True, **facts: object) -> LeadSample:
        self.number += 1
        facts = {"twist": AHEAD, **facts}
        return LeadSample(number=self.number, at_s=self.now_s, is_held=held, **facts)  # type: ignore[arg-type]

    def act(self, *, held: bool = True, passed_s: float = 0.02, **facts: object) -> LeadRow:
        """One period with a sample."""
        self.now_s += passed_s
        self.session.take(self.sample(held=held, **facts), self.now_s)
        return self.session.row(self.now_s, AT_ZERO)

    def wait(self, seconds: float) -> LeadRow:
        """Nothing comes for a while."""
        self.now_s += seconds
        return self.session.row(self.now_s, AT_ZERO)


@pytest.fixture
def person() -> Person:
    """Whose switch was released once."""
    person = Person()
    person.act(held=False)
    return person


def test_nothing_moves_before_the_switch_was_released_and_pressed() -> None:
    person = Person()
    rows = [person.act() for _ in range(20)]
    assert {row.kind for row in rows} == {"still", "rest"}
    assert person.act(held=False).kind == "rest"
    assert person.act().kind == "twist"


def test_a_released_switch_brakes_first_and_then_rests(person: Person) -> None:
    person.act()
    rows = [person.act(held=False) for _ in range(20)]
    kinds = [row.kind for row in rows]
    assert kinds == sorted(kinds, reverse=True)
    assert 12 <= kinds.count("still") <= 16
    assert person.act().kind == "twist"


def test_a_silent_source_brakes_and_needs_the_switch_anew(person: Person) -> None:
    assert person.act().kind == "twist"
    assert person.wait(SILENT_S - 0.01).kind == "still"
    assert person.wait(0.02).kind == "still"
    assert person.session.why_still == "silent: release the switch and press it again"
    assert person.act().kind == "still"
    assert person.session.why_still == "release the switch and press it again"
    person.act(held=False)
    assert person.act().kind == "twist"


@pytest.mark.parametrize(
    ("rate_hz", "late_s"), [(100.0, LATE_S), (50.0, LATE_S), (30.0, 2.2 / 30.0), (15.0, LATEST_S)]
)
def test_a_source_is_late_by_its_own_rate_and_led_on_at_once(rate_hz: float, late_s: float) -> None:
    person = Person()
    person.act(held=False)
    for _ in range(20):
        assert person.act(passed_s=1.0 / rate_hz).kind == "twist"
    assert person.wait(late_s - 0.001).kind == "twist"
    assert person.wait(0.002).kind == "still"
    assert person.session.why_still == "late: the source is slow"
    assert person.act(passed_s=0.001).kind == "twist"


def test_a_correction_is_not_dropped_for_a_sample_that_is_late() -> None:
    person = Person("blend")
    person.act(held=False)
    person.act()
    assert person.wait(SILENT_S - 0.01).kind == "twist"
    assert person.wait(0.02).kind == "still"


def test_a_device_that_repeats_what_it_measured_is_silent(person: Person) -> None:
    person.act()
    sample = person.sample()
    for number in range(10):
        again = replace(sample, number=sample.number + number)
        person.session.take(again, person.now_s)
        person.now_s += 0.01
    assert person.session.row(person.now_s, AT_ZERO).kind == "still"


def test_a_source_that_is_gone_ends_the_lead(person: Person) -> None:
    person.act()
    with pytest.raises(NotReadyError, match=r"silent for 1\.0 s; the arm rests.*again"):
        person.wait(GONE_S + 0.01)


def test_a_late_sample_does_not_move_the_arm(person: Person) -> None:
    person.act()
    late = replace(person.sample(twist=-AHEAD), at_s=person.now_s + 0.001)
    person.now_s += SILENT_S + 0.02
    person.session.take(late, person.now_s)
    assert person.session.row(person.now_s, AT_ZERO).kind == "still"


def test_an_older_sample_is_left_out(person: Person) -> None:
    first, second = person.sample(), person.sample(twist=-AHEAD)
    person.session.take(second, person.now_s)
    person.session.take(first, person.now_s)
    row = person.session.row(person.now_s, AT_ZERO)
    assert row.values[0] == pytest.approx(-0.1)


@pytest.mark.parametrize("by_s", [-0.5, 0.06, float("nan")])
def test_a_wrong_clock_is_told(person: Person, by_s: float) -> None:
    person.act()
    wrong = replace(person.sample(), at_s=person.now_s + by_s)
    with pytest.raises(InvalidInputError, match=r"clock of the source is wrong.*load the page"):
        person.session.take(wrong, person.now_s)


@pytest.mark.parametrize(
    "facts",
    [
        {"twist": np.array([np.nan, 0, 0, 0, 0, 0])},
        {"twist": np.array([0, 0, 0, 0, np.inf, 0])},
        {"twist": np.array([1e6, 0, 0, 0, 0, 0])},
        {"twist": np.array([0, 0, 0, 0, 0, 31.0])},
        {"twist": None, "velocities": {JOINTS[0]: 1e9}},
        {"twist": None, "positions": {**AT_ZERO, JOINTS[0]: float("nan")}},
        {"gripper_open": float("nan")},
        {"gripper_open": 1.01},
    ],
)
def test_numbers_that_nobody_means_end_the_lead(person: Person, facts: dict[str, object]) -> None:
    with pytest.raises(UnsafeError, match="Start leading again"):
        person.session.take(person.sample(**facts), person.now_s)


@pytest.mark.parametrize(
    "facts",
    [
        {"twist": None, "velocities": {"elbow": 0.1}},
        {"twist": None, "positions": {JOINTS[0]: 0.1}},
        {"twist": np.zeros(3)},
    ],
)
def test_what_is_not_of_the_arm_is_named(person: Person, facts: dict[str, object]) -> None:
    with pytest.raises(InvalidInputError):
        person.session.take(person.sample(**facts), person.now_s)


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_speeds_are_bounded_in_their_direction_and_scaled(scale: float) -> None:
    person = Person(scale=scale)
    person.act(held=False)
    row = person.act(twist=np.array([3.0, 4.0, 0.0, 0.0, 0.0, 20.0]))
    assert row.values[:3] == pytest.approx(np.array([0.6, 0.8, 0.0]) * 0.25 * scale)
    assert row.values[3:] == pytest.approx([0.0, 0.0, 0.8 * scale])
    assert person.act().values[0] == pytest.approx(min(0.1 * scale, 0.25 * scale))


def greatest_step(profile: RobotProfile) -> np.ndarray:
    """Of a joint in one period at the share of a lead [rad or m]."""
    assert profile.limits is not None
    return 0.25 * np.asarray(profile.limits.velocity) / 50.0


def test_a_leader_is_approached_at_a_bounded_speed(person: Person) -> None:
    wanted = dict.fromkeys(JOINTS, 0.2)
    before = np.zeros(len(JOINTS))
    for _ in range(5):
        row = person.act(twist=None, positions=wanted)
        assert row.kind == "joint_position"
        assert (np.abs(row.values - before) <= greatest_step(PROFILE) + 1e-12).all()
        before = row.values
    assert (before > 0.0).all()


def test_a_leader_that_is_far_has_to_come_nearer(person: Person) -> None:
    far = {**AT_ZERO, JOINTS[0]: 0.31}
    with pytest.raises(NotReadyError, match="Bring the leader nearer"):
        person.act(twist=None, positions=far)


def test_a_leader_jumps_no_farther_than_its_speed_allows(person: Person) -> None:
    person.act(twist=None, positions=AT_ZERO)
    row = person.act(twist=None, positions={**AT_ZERO, JOINTS[0]: 3.0})
    assert row.values[0] == pytest.approx(greatest_step(PROFILE)[0])


def test_joints_are_bounded_to_a_share_of_their_speed(person: Person) -> None:
    row = person.act(twist=None, velocities={JOINTS[0]: 20.0})
    assert row.keys == (JOINTS[0],)
    assert row.values[0] == pytest.approx(greatest_step(PROFILE)[0] * 50.0)
