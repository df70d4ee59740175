"""What `roboneuron plugins new robot --urdf` takes for base, TCP, joints, gripper, or refuses."""

from __future__ import annotations

from itertools import pairwise

import pytest
from urdf_samples import ARM, FINGERS, LIMIT, SLIDE, joint, link, robot

from rn_standard.declared_arm.urdf_guesses import ArmParts, Chosen, guess
from rn_standard.declared_arm.urdf_tree import UrdfTree
from roboneuron import ConfigurationError

JOINTS = ("j1", "j2", "j3")


def parts(*elements: str, **chosen: object) -> ArmParts:
    return guess(UrdfTree(robot(*elements)), Chosen(**chosen))


def refusal(*elements: str, **chosen: object) -> str:
    with pytest.raises(ConfigurationError) as caught:
        parts(*elements, **chosen)
    return str(caught.value)


def changed(old: str, new: str) -> tuple[str, ...]:
    """`ARM` with another text in its elements."""
    assert any(old in element for element in ARM)
    return tuple(element.replace(old, new) for element in ARM)


@pytest.mark.parametrize("kind", ["revolute", "continuous", "prismatic"])
def test_an_arm_without_gripper_is_recognised(kind):
    found = parts(*changed('name="j2" type="revolute"', f'name="j2" type="{kind}"'))
    assert (found.base, found.tcp, found.joints) == ("base_link", "tcp", JOINTS)
    assert found.gripper is None
    assert found.left == ()
    assert set(found.grounds) == {"base", "tcp", "joints", "gripper"}


@pytest.mark.parametrize(
    ("tools", "expected"),
    [
        (("flange", "tool0"), "tool0"),
        (("ee_link", "tool0"), "tool0"),
        (("hand", "hand_tcp"), "hand_tcp"),
        (("end_effector_link", "camera_link"), "end_effector_link"),
        (("gripper_frame_link", "wrist_camera_optical_frame"), "gripper_frame_link"),
    ],
)
def test_the_tool_is_found_by_its_name(tools, expected):
    others = [element for name in tools for element in (link(name, ""), mount(name))]
    assert parts(*ARM[:4], *ARM[5:8], *others).tcp == expected


def mount(child: str, parent: str = "l3") -> str:
    return joint(f"to_{child}", parent, child, "fixed")


def test_the_only_end_is_the_tool_whatever_its_name():
    assert parts(*ARM[:4], *ARM[5:8]).tcp == "l3"


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        (("world", "base_link"), "base_link"),
        (("world", "pedestal"), "pedestal"),
        (("robot_base", "plate"), "robot_base"),
        (("mount", "arm_link0"), "mount"),
    ],
)
def test_the_base_is_no_world(links, expected):
    first, second = links
    elements = [e for e in ARM if "base_link" not in e]
    elements += [link(first, ""), link(second), mount(second, first)]
    elements.append(joint("j1", second, "l1", axis="0 0 1"))
    assert parts(*elements).base == expected


def test_fingers_are_the_gripper_and_no_part_of_the_arm():
    found = parts(*ARM, *FINGERS)
    assert (found.tcp, found.joints) == ("tcp", JOINTS)
    assert found.gripper is not None
    assert (found.gripper.joint, found.gripper.followers) == ("slide", ("other",))
    assert (found.gripper.closed, found.gripper.opened) == (0.0, 0.04)
    assert found.gripper.is_measured


def test_fingers_that_close_with_a_growing_position_are_open_at_the_lower_limit():
    turned = [e.replace('axis xyz="0 1 0"', 'axis xyz="0 X 0"') for e in FINGERS]
    turned = [e.replace('axis xyz="0 -1 0"', 'axis xyz="0 1 0"') for e in turned]
    turned = [e.replace("0 X 0", "0 -1 0").replace("0.01 0.1", "0.05 0.1") for e in turned]
    gripper = parts(*ARM, *turned).gripper
    assert gripper is not None
    assert (gripper.closed, gripper.opened) == (0.04, 0.0)


def test_a_single_jaw_is_a_gripper_whose_open_end_is_not_known():
    jaw = joint("gripper", "l3", "jaw")
    found = parts(*ARM, link("jaw"), jaw)
    assert found.joints == JOINTS
    assert found.gripper is not None
    assert (found.gripper.joint, found.gripper.is_measured) == ("gripper", False)


def test_fingers_that_move_by_themselves_are_no_gripper_unless_chosen():
    fingers = (
        *(link("f1"), link("f2")),
        *(joint(f"finger_{i}", "l3", f"f{i}", "prismatic", more=SLIDE) for i in (1, 2)),
    )
    found = parts(*ARM, *fingers)
    assert found.gripper is None
    assert found.left == ("finger_1", "finger_2")
    assert "--gripper" in found.grounds["gripper"]
    chosen = parts(*ARM, *fingers, gripper="finger_2").gripper
    assert chosen is not None
    assert chosen.joint == "finger_2"


def test_a_gripper_can_be_left_out():
    found = parts(*ARM, *FINGERS, gripper="none")
    assert found.gripper is None
    assert found.left == ("slide",)


def second_arm(count: int) -> list[str]:
    names = ["base_link", *(f"r{i}" for i in range(count))]
    elements = [link(name) for name in names[1:]]
    pairs = pairwise(names)
    return [*elements, *(joint(f"right_{b}", a, b) for a, b in pairs)]


def test_two_arms_are_refused_with_their_tools():
    told = refusal(*ARM, *second_arm(3))
    assert "tcp" in told
    assert "r2" in told
    assert "--tcp" in told


@pytest.mark.parametrize(
    "chosen", [{"tcp": "r2"}, {"joints": ("right_r1", "right_r0", "right_r2")}]
)
def test_one_of_two_arms_is_chosen_by_its_tool_or_its_joints(chosen):
    found = parts(*ARM, *second_arm(3), **chosen)
    assert found.tcp == "r2"
    assert found.joints == ("right_r0", "right_r1", "right_r2")
    assert found.left == JOINTS


def test_a_wheel_is_no_rival_of_an_arm():
    wheel = joint("wheel", "base_link", "r0", "continuous", more="")
    found = parts(*ARM, link("r0"), wheel)
    assert found.joints == JOINTS
    assert found.left == ("wheel",)


def test_a_chosen_base_shortens_the_arm():
    found = parts(*ARM, base="l1")
    assert (found.base, found.joints, found.left) == ("l1", ("j2", "j3"), ("j1",))


def test_chosen_joints_shorten_the_arm():
    found = parts(*ARM, joints=("j3", "j2"))
    assert (found.base, found.joints) == ("l1", ("j2", "j3"))


@pytest.mark.parametrize(
    ("chosen", "names"),
    [
        ({"base": "bass_link"}, ("--base", "bass_link", "base_link")),
        ({"tcp": "tpc"}, ("--tcp", "tpc")),
        ({"joints": ("j1", "j4")}, ("--joints", "j4")),
        ({"joints": ("j1", "j3")}, ("--joints", "j2")),
        ({"gripper": "mount"}, ("--gripper", "mount")),
        ({"tcp": "base_link"}, ("base_link",)),
        ({"base": "tcp", "tcp": "l2"}, ("tcp", "l2")),
    ],
)
def test_a_choice_that_does_not_fit_is_refused_by_name(chosen, names):
    told = refusal(*ARM, **chosen)
    assert all(name in told for name in names), told


def test_two_possible_tools_are_asked_for_by_name():
    told = refusal(
        *ARM[:4],
        *ARM[5:8],
        link("left_tool"),
        link("right_tool"),
        mount("left_tool"),
        mount("right_tool"),
    )
    assert "left_tool" in told
    assert "right_tool" in told
    assert "--tcp" in told


@pytest.mark.parametrize(
    ("elements", "names"),
    [
        ((), ("no links",)),
        ((link("a"), link("b"), mount("b", "a")), ("No joint",)),
        ((link("a"), link("b"), joint("x", "a", "b", "floating")), ("No joint",)),
        ((*ARM, link("alone")), ("base_link", "alone")),
        ((*ARM, joint("j4", "tcp", "gone")), ("j4", "gone")),
        ((*ARM, joint("j4", "base_link", "l3")), ("l3",)),
        ((*ARM, joint("j1", "l3", "tcp")), ("j1",)),
        ((*ARM, link("l4"), joint("j4", "l3", "l4", more='<mimic joint="gone"/>')), ("j4", "gone")),
    ],
)
def test_a_description_that_is_no_arm_is_refused_with_the_reason(elements, names):
    told = refusal(*elements)
    assert all(name in told for name in names), told


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<robot", "XML"),
        ("<sdf/>", "sdf"),
        ('<robot xmlns:xacro="http://ros.org/wiki/xacro"><xacro:arm/></robot>', "xacro"),
        (robot(*changed('xyz="0 0 0.25"', 'xyz="0 0 high"')), "read"),
    ],
)
def test_what_is_no_urdf_is_refused(text, word):
    with pytest.raises(ConfigurationError) as caught:
        UrdfTree(text)
    assert word in str(caught.value)


def test_links_in_a_circle_are_refused():
    ring = (link("a"), link("b"), link("c"), mount("b", "a"), mount("c", "b"), mount("a", "c"))
    assert "no joint" in refusal(*ring)
    assert LIMIT in ARM[5], "a sample has limits unless it says otherwise"
