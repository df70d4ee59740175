"""Who may move the arm, by the rows of leads and their absence; and how a correction is added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_standard.teleoperation.authority import LOST_S, SILENT_S, Authority
from rn_standard.teleoperation.correction import Correction
from rn_standard.teleoperation.in_control import space_row, twist_in_base
from rn_standard.teleoperation.rows import Acting, LeadRow
from rn_testing.fakes import gantry_profile
from roboneuron import InvalidInputError, JointSample, UnsafeError, robot_space


def row(number: int, kind: str = "twist", mode: str = "person", session: str = "one") -> LeadRow:
    values = np.zeros(6) if kind == "twist" else np.zeros(0)
    return LeadRow(
        session=session,
        number=number,
        mode=mode,  # type: ignore[arg-type]
        kind=kind,  # type: ignore[arg-type]
        keys=("base",) if kind == "twist" else (),
        values=values,
    )


def test_the_policy_acts_until_a_person_leads_and_again_after_the_hand_back() -> None:
    authority = Authority()
    assert (authority.who, authority.why_no_policy(5)) == ("policy", "")
    assert authority.take(row(1), 10.0) == ""
    assert (authority.who, authority.why_no_policy(5)) == ("person", "taken_over")
    authority.release(100)
    assert authority.who == "policy"
    assert authority.why_no_policy(99) == "before_hand_back"
    assert authority.why_no_policy(100) == ""
    assert authority.take(row(2), 10.02) == "lead_ended"
    assert authority.take(row(1, session="two"), 10.04) == ""


def test_a_correction_leaves_the_policy_at_work() -> None:
    authority = Authority()
    authority.take(row(1, mode="blend"), 10.0)
    assert (authority.who, authority.why_no_policy(5)) == ("blend", "")
    assert authority.look(10.0 + SILENT_S + 0.01) == "silent"
    assert authority.why_no_policy(5) == "taken_over"
    assert authority.take(row(2, "rest", mode="blend"), 10.2) == ""
    assert authority.why_no_policy(5) == ""


def test_one_lead_at_a_time_and_in_order() -> None:
    authority = Authority()
    authority.take(row(3), 10.0)
    assert authority.take(row(4, session="two"), 10.01) == "other_lead"
    assert authority.take(row(3), 10.02) == "reordered_lead"
    assert authority.take(row(2), 10.02) == "reordered_lead"
    assert authority.take(row(4), 10.02) == ""


@pytest.mark.parametrize(("rate_hz", "late_s"), [(100.0, 0.05), (50.0, 0.05), (30.0, 2.5 / 30.0)])
def test_a_person_who_is_late_is_waited_for_by_the_period_of_the_lead(
    rate_hz: float, late_s: float
) -> None:
    authority = Authority()
    authority.take(replace(row(1), rate_hz=rate_hz), 10.0)
    assert authority.look(10.0 + late_s - 0.001) == ""
    assert authority.look(10.0 + late_s + 0.001) == "late"
    assert authority.take(row(2), 10.0 + late_s + 0.002) == ""
    assert authority.look(10.0 + late_s + 0.003) == ""


def test_a_correction_that_is_late_leaves_the_policy_at_work() -> None:
    authority = Authority()
    authority.take(row(1, mode="blend"), 10.0)
    assert authority.look(10.0 + SILENT_S - 0.01) == ""
    assert authority.why_no_policy(5) == ""


@pytest.mark.parametrize("is_seen", [True, False])
def test_after_a_silence_the_switch_is_needed_anew(is_seen: bool) -> None:
    authority = Authority()
    authority.take(row(1), 10.0)
    assert authority.look(10.0 + SILENT_S - 0.01) == "late"
    assert authority.who == "person"
    if is_seen:
        assert authority.look(10.0 + SILENT_S + 0.01) == "silent"
    back_s = 10.0 + SILENT_S + 0.02
    assert authority.take(row(2), back_s) == "lead_needs_release"
    assert authority.who == "nobody"
    assert authority.why_no_policy(5) == "taken_over"
    assert authority.take(row(3, "rest"), back_s + 0.02) == ""
    assert authority.take(row(4), back_s + 0.04) == ""
    assert authority.look(back_s + 0.04 + LOST_S + 0.01) == "lost"


@pytest.mark.parametrize("gripper", [None, 0.0, 1.0])
def test_a_row_survives_its_message(gripper: float | None) -> None:
    sent = LeadRow(
        session="ab12",
        number=7,
        mode="blend",
        kind="joint_velocity",
        keys=("a", "b"),
        values=np.array([0.25, -1.5]),
        gripper_open=gripper,
        rate_hz=30.0,
    )
    got = LeadRow.from_message(sent.to_message())
    for name in ("session", "number", "mode", "kind", "keys", "gripper_open", "rate_hz"):
        assert getattr(got, name) == getattr(sent, name)
    assert got.values.tolist() == [0.25, -1.5]


@pytest.mark.parametrize(
    ("labels", "data"),
    [
        ([], []),
        ([("twist@50:base", 6)], [0.0] * 6),
        ([("twist@50:base", 6), ("lead:person:a:1", 0)], [0.0] * 5),
        ([("twist@50:world", 6), ("lead:person:a:1", 0)], [0.0] * 6),
        ([("twist@0:base", 6), ("lead:person:a:1", 0)], [0.0] * 6),
        ([("twist@nan:base", 6), ("lead:person:a:1", 0)], [0.0] * 6),
        ([("jump@50:base", 6), ("lead:person:a:1", 0)], [0.0] * 6),
        ([("twist@50:base", 6), ("lead:god:a:1", 0)], [0.0] * 6),
        ([("twist@50:base", 6), ("lead:person:a:first", 0)], [0.0] * 6),
        ([("joint_velocity@50:a,a", 2), ("lead:person:a:1", 0)], [0.0] * 2),
        ([("twist@50:base", 6), ("lead:person:a:1", 0), ("gripper", 1)], [0.0] * 6 + [1.5]),
        ([("twist@50:base", 6), ("lead:person:a:1", 0), ("gripper", 1)], [0.0] * 6),
        ([("twist@50:base", 6), ("lead:person:a:1", 0), ("arm", 1)], [0.0] * 7),
    ],
)
def test_a_message_that_is_no_row_is_refused(
    labels: list[tuple[str, int]], data: list[float]
) -> None:
    from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

    dims = [MultiArrayDimension(label=label, size=size, stride=size) for label, size in labels]
    message = Float64MultiArray(layout=MultiArrayLayout(dim=dims), data=data)
    with pytest.raises(InvalidInputError):
        LeadRow.from_message(message)


def test_a_row_that_is_not_finite_is_unsafe() -> None:
    message = row(1).to_message()
    message.data[2] = float("nan")
    with pytest.raises(UnsafeError):
        LeadRow.from_message(message)


def test_what_control_tells_survives_its_message() -> None:
    told = Acting(
        who="blend", session="ab:12", number=9, share=0.5, limits="speed,zone", note="a: b"
    )
    assert Acting.from_message(told.to_message()) == told
    with pytest.raises(InvalidInputError):
        Acting.from_message(row(1).to_message())


def test_a_correction_of_steps_is_what_was_asked_since_the_last_one() -> None:
    correction, twist = Correction(), np.array([0.1, 0, 0, 0, 0, 0.2])
    assert correction.add(twist, 0.1) == pytest.approx(twist * 0.1)
    assert correction.add(twist, 0.1) == pytest.approx(twist * 0.1)


def test_a_correction_of_places_grows_to_its_bound_and_ends() -> None:
    correction, twist = Correction(is_kept=True), np.array([0.1, 0, 0, 0, 0, 1.0])
    assert correction.add(twist, 0.1)[0] == pytest.approx(0.01)
    assert correction.add(twist, 0.1)[0] == pytest.approx(0.02)
    for _ in range(100):
        offset = correction.add(twist, 0.1)
    assert offset[0] == pytest.approx(0.08)
    assert offset[5] == pytest.approx(0.4)
    correction.reset()
    assert correction.add(twist, 0.1)[0] == pytest.approx(0.01)


def test_a_twist_of_the_tool_is_turned_into_the_base() -> None:
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    ahead = LeadRow(
        session="a",
        number=1,
        mode="person",
        kind="twist",
        keys=("tool",),
        values=np.array([0.1, 0, 0, 0.2, 0, 0]),
    )
    assert twist_in_base(ahead, turned) == pytest.approx([0, 0.1, 0, 0, 0.2, 0])


def test_joints_that_a_lead_does_not_name_stand_still() -> None:
    profile = gantry_profile()
    first = profile.arm_joints[0]
    joints = JointSample(
        names=profile.arm_joints, position=np.full(len(profile.arm_joints), 0.3), stamp_ns=1
    )
    asked = LeadRow(
        session="a",
        number=1,
        mode="person",
        kind="joint_velocity",
        keys=(first,),
        values=np.array([0.1]),
    )
    velocities = space_row(robot_space("joint_velocity", profile), asked, joints)
    assert velocities[0] == 0.1
    assert not velocities[1:].any()
    moved = replace(asked, kind="joint_position", values=np.array([0.4]), gripper_open=0.5)
    positions = space_row(robot_space("joint_position", profile), moved, joints)
    assert positions == pytest.approx([0.4, *[0.3] * (len(profile.arm_joints) - 1), 0.5])
    silent = replace(moved, gripper_open=None)
    assert space_row(robot_space("joint_position", profile), silent, joints)[-1] == 0.0
    wrong = LeadRow(
        session="a",
        number=1,
        mode="person",
        kind="joint_position",
        keys=("elbow",),
        values=np.zeros(1),
    )
    with pytest.raises(InvalidInputError, match="elbow are no joints"):
        space_row(robot_space("joint_position", profile), wrong, joints)
