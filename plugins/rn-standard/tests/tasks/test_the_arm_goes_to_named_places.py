"""move_to: postures by the joints' tool, places in straight parts by the end effector's, and
nothing by guessing.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from rn_standard.tasks import moving
from rn_standard.tasks.moving import Mover, Places, check_places
from rn_standard.tasks.options import PlaceOptions, PostureOptions, TasksSections
from roboneuron import matrix_from_quaternion, matrix_from_rotvec, rotvec_from_matrix
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, StateError

SHELF = PlaceOptions(
    position_m=(0.5, -0.8, 0.4), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0), gripper_open=1.0
)
OPTIONS = TasksSections(
    postures={"retract": PostureOptions(joints={"a": 0.5}, summary="out of the way")},
    places={
        "shelf": SHELF,
        "above": PlaceOptions(position_m=(0.5, 0.0, 0.7)),
        "beside": PlaceOptions(position_m=(0.5, 0.1, 0.3), gripper_open=0.5, arm="right"),
    },
)


class Arm:
    """A TCP that does what it is told exactly, unless it is stuck; keeps the calls."""

    def __init__(self) -> None:
        self.position = np.array([0.45, 0.0, 0.3])
        self.rotation = np.eye(3)
        self.asked: set[str] = set()
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.is_stuck = self.is_stopped = False
        self.answer: dict[str, Any] = {"allowed": True, "error": 0.001, "duration_s": 0.5}
        self.tools = {
            name: SimpleNamespace(call=self._caller(name)) for name in ("move_joints", "move_ee")
        }
        self.starts = SimpleNamespace(arm_stops=0, reason="a reflex")
        running = SimpleNamespace(view=lambda kind: SimpleNamespace(report=None))
        self.host: Any = SimpleNamespace(
            tools=self, loop=SimpleNamespace(starts=self.starts), modules=running
        )

    def get(self, name: str) -> Any:
        return self.tools.get(name)

    def _caller(self, name: str) -> Any:
        async def call(arguments: dict[str, Any], context: Any) -> Any:
            self.calls.append((name, arguments))
            self.starts.arm_stops += self.is_stopped
            if name == "move_ee" and not self.is_stuck:
                self.position = self.position + [arguments.get(f"d{axis}_m", 0.0) for axis in "xyz"]
                turn = np.array([arguments.get(f"r{axis}_rad", 0.0) for axis in "xyz"])
                self.rotation = matrix_from_rotvec(turn) @ self.rotation
            return SimpleNamespace(structured=self.answer)

        return call

    def _pose(self, arm: str) -> Any:
        self.asked.add(arm)
        return self.position, self.rotation

    def move_to(self, name: str) -> Any:
        async def run(work: Any) -> Any:
            return work(lambda _: None)

        mover = Mover(self.host, Places(self.host, OPTIONS), self._pose)
        return anyio.run(mover, name, SimpleNamespace(run=run))


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Arm:
    each = [SimpleNamespace(name=name, gripper="finger") for name in ("", "left", "right")]
    profile = SimpleNamespace(
        home_rad=np.array([0.1, 0.2]), arm_joints=("a", "b"), arms=(), each_arm=each
    )
    monkeypatch.setattr(moving, "profile_of", lambda host: profile)
    return Arm()


def test_a_posture_is_one_motion_of_its_joints(arm: Arm) -> None:
    moved = arm.move_to("retract")
    assert arm.calls == [("move_joints", {"positions": {"a": 0.5}})]
    assert (moved.kind, moved.error, moved.took_s) == ("posture", 0.001, 0.5)


def test_home_is_the_robots_own_unless_the_configuration_has_another(arm: Arm) -> None:
    arm.move_to("home")
    assert arm.calls == [("move_joints", {"positions": {"a": 0.1, "b": 0.2}})]
    own = TasksSections(postures={"home": PostureOptions(joints={"a": 1.0})})
    assert Places(arm.host, own).postures()["home"].joints == {"a": 1.0}
    assert Places(arm.host, OPTIONS).choices() == {
        "home": "the robot's own safe posture",
        "retract": "out of the way",
        "shelf": "",
        "above": "",
        "beside": "",
    }


def test_a_place_is_reached_in_parts_that_are_short_enough_and_the_gripper_moves_last(
    arm: Arm,
) -> None:
    moved = arm.move_to("shelf")
    *parts, last = [arguments for _, arguments in arm.calls]
    assert last == {"gripper_open": 1.0}
    assert len(parts) > 2
    for part in parts:
        assert np.linalg.norm([part[f"d{axis}_m"] for axis in "xyz"]) <= 0.3 + 1e-9
        assert np.linalg.norm([part[f"r{axis}_rad"] for axis in "xyz"]) <= 1.2 + 1e-9
    # `move_to` calls that there
    np.testing.assert_allclose(arm.position, SHELF.position_m, atol=0.004)
    wanted = matrix_from_quaternion(np.array(SHELF.quaternion_xyzw))
    assert np.linalg.norm(rotvec_from_matrix(wanted @ arm.rotation.T)) < 0.02
    assert (moved.kind, moved.took_s) == ("place", 0.5 * len(arm.calls))


def test_a_place_without_orientation_keeps_the_one_there_is(arm: Arm) -> None:
    arm.rotation = before = matrix_from_rotvec(np.array([0.3, 0.0, 0.0]))
    arm.move_to("above")
    np.testing.assert_array_equal(arm.rotation, before)


def test_what_does_not_come_about_is_an_error(arm: Arm) -> None:
    arm.is_stuck = True
    with pytest.raises(NotReadyError, match="does not reach 'shelf'"):
        arm.move_to("shelf")
    arm.answer = {"allowed": False, "reason": "outside of the workspace"}
    for name in ("shelf", "home"):
        with pytest.raises(RefusedError, match="outside of the workspace"):
            arm.move_to(name)
    arm.answer = {"allowed": True, "simulated": True}
    with pytest.raises(RefusedError, match="only simulated"):
        arm.move_to("home")
    del arm.tools["move_joints"]
    with pytest.raises(NotReadyError, match="no tool move_joints"):
        arm.move_to("home")


def test_an_unknown_name_is_refused_with_those_there_are(arm: Arm) -> None:
    with pytest.raises(InvalidInputError) as caught:
        arm.move_to("kitchen")
    assert caught.value.hint == "There are: home, retract, shelf, above, beside."
    assert arm.calls == []


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        (
            TasksSections(postures={"a": OPTIONS.postures["retract"]}, places={"a": SHELF}),
            "a posture and a place",
        ),
        (TasksSections(places={"hold": SHELF}), "'hold' cannot be a name"),
        (
            TasksSections(
                places={"a": SHELF.model_copy(update={"quaternion_xyzw": (0.0, 0.0, 0.0, 0.1)})}
            ),
            "not of unit length",
        ),
    ],
)
def test_names_and_orientations_that_mean_nothing_are_refused_at_the_start(
    sections: TasksSections, words: str
) -> None:
    with pytest.raises(InvalidInputError, match=words):
        check_places(sections)
    check_places(OPTIONS)


def test_what_is_left_of_a_way_is_not_made_after_a_stop(arm: Arm) -> None:
    arm.is_stopped = True
    with pytest.raises(StateError, match="stopped on its way to 'shelf': a reflex"):
        arm.move_to("shelf")
    assert len(arm.calls) == 1


def test_the_arm_that_a_place_names_goes_there(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InvalidInputError, match="'beside' names the arm 'right'"):
        arm.move_to("beside")
    arms = [SimpleNamespace(name=name, gripper="finger") for name in ("left", "right")]
    pair = SimpleNamespace(home_rad=None, arms=arms, each_arm=arms)
    monkeypatch.setattr(moving, "profile_of", lambda host: pair)
    arm.move_to("beside")
    assert arm.asked == {"right"}
    assert {call[1]["arm"] for call in arm.calls} == {"right"}
    with pytest.raises(
        InvalidInputError, match="'above' names no arm; the arms are 'left', 'right'"
    ):
        arm.move_to("above")
