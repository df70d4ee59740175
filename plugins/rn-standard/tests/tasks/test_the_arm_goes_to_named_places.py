"""move_to: postures by the joints' tool, places in straight parts by the end effector's, and
nothing by guessing.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from rn_standard.tasks import moving, named_targets
from rn_standard.tasks.moving import Mover, MoveToArguments
from rn_standard.tasks.named_targets import Places, check_places
from rn_standard.tasks.options import (
    GestureOptions,
    PlaceOptions,
    PostureOptions,
    TasksSections,
)
from roboneuron import LocatedObject, matrix_from_quaternion, matrix_from_rotvec, rotvec_from_matrix
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, StateError
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.marks import CellLook
from roboneuron.tools.arm.options import ArmToolsOptions

SHELF = PlaceOptions(
    position_m=(0.5, -0.8, 0.4), quaternion_xyzw=(1.0, 0.0, 0.0, 0.0), gripper_open=1.0
)
OPTIONS = TasksSections(
    postures={"retract": PostureOptions(joints={"a": 0.5}, summary="out of the way")},
    gestures={"nod": GestureOptions(steps=({"b": 0.3}, {"b": -0.3}), times=2, summary="nods")},
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
            name: SimpleNamespace(call=self._caller(name), handler=None)
            for name in ("move_joints", "move_ee")
        }
        self.starts = SimpleNamespace(arm_stops=0, reason="a reflex")
        running = SimpleNamespace(view=lambda kind: SimpleNamespace(report=None))
        self.looker: Any = None
        limits = SimpleNamespace(max_speed_m_s=0.2, max_turn_rad_s=1.0)
        self.host: Any = SimpleNamespace(
            tools=self,
            loop=SimpleNamespace(starts=self.starts, limits=limits),
            modules=running,
            features=self,
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

    @property
    def loaded(self) -> dict[str, Any]:
        arm = {"tools-arm": SimpleNamespace(options=ArmToolsOptions())}
        return arm if self.looker is None else {**arm, "sight": self.looker}

    def _mover(self) -> tuple[Mover, Any]:
        async def run(work: Any) -> Any:
            return work(lambda _: None)

        mover = Mover(self.host, Places(self.host, OPTIONS), self._pose)
        return mover, SimpleNamespace(
            run=run, ask=None, who="agent", role="operator", simulated=False
        )

    def move_to(self, name: str) -> Any:
        mover, context = self._mover()
        return anyio.run(mover, name, context)

    def go(self, **arguments: Any) -> Any:
        mover, context = self._mover()
        return anyio.run(mover.go, MoveToArguments(**arguments), context)


class FakeLooker:
    """Sees cubes; each look moves them by `drift_m` along x."""

    table_m = 0.0

    def __init__(self, *names: str, drift_m: float = 0.0) -> None:
        self._names, self._drift_m, self._looks = names, drift_m, 0
        self.problems: dict[str, str] = {}
        self._last: CellLook | None = None

    def look(self, who: str, newer_than_ns: int = 0) -> CellLook:
        objects = tuple(
            LocatedObject(
                label="cube",
                colour=name,
                position_m=np.array([0.4 + 0.1 * n + self._looks * self._drift_m, 0.0, 0.02]),
                size_m=np.full(3, 0.04),
                uncertainty_m=0.002,
                cameras=("above",),
                seen_at_ns=1,
            )
            for n, name in enumerate(self._names)
        )
        images: Any = () if self.problems else (object(),)
        view = CellView(
            images=images, frames=(), problems=self.problems, tcps={}, taken_ns=1, taken_s=0.0
        )
        self._looks += 1
        self._last = CellLook(view=view, objects=objects)
        return self._last

    def last_look(self, who: str) -> CellLook | None:
        return self._last

    def forget(self, one: LocatedObject) -> None:
        raise AssertionError("nothing is moved here")


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Arm:
    each = [SimpleNamespace(name=name, gripper="finger") for name in ("", "left", "right")]
    profile = SimpleNamespace(
        home_rad=np.array([0.1, 0.2]),
        arm_joints=("a", "b"),
        arms=(),
        each_arm=each,
        gestures={"wave": ({"a": 1.0}, {"a": 0.0})},
    )
    for module in (moving, named_targets):
        monkeypatch.setattr(module, "profile_of", lambda host: profile)
    return Arm()


def test_a_posture_is_one_motion_of_its_joints(arm: Arm) -> None:
    moved = arm.move_to("retract")
    assert arm.calls == [("move_joints", {"positions": {"a": 0.5}})]
    assert (moved.kind, moved.error, moved.took_s) == ("posture", 0.001, 0.5)


@pytest.mark.parametrize(
    ("name", "steps"),
    [("nod", [{"b": 0.3}, {"b": -0.3}] * 2), ("wave", [{"a": 1.0}, {"a": 0.0}])],
)
def test_a_gesture_is_one_motion_after_the_other(
    arm: Arm, name: str, steps: list[dict[str, float]]
) -> None:
    moved = arm.move_to(name)
    assert arm.calls == [("move_joints", {"positions": step}) for step in steps]
    assert (moved.kind, moved.took_s) == ("gesture", 0.5 * len(steps))


def test_a_gesture_ends_with_the_stop_that_comes_in_its_middle(arm: Arm) -> None:
    arm.is_stopped = True
    with pytest.raises(StateError, match="stopped on its way to 'nod': a reflex"):
        arm.move_to("nod")
    assert len(arm.calls) == 1


def test_home_is_the_robots_own_unless_the_configuration_has_another(arm: Arm) -> None:
    arm.move_to("home")
    assert arm.calls == [("move_joints", {"positions": {"a": 0.1, "b": 0.2}})]
    own = TasksSections(postures={"home": PostureOptions(joints={"a": 1.0})})
    assert Places(arm.host, own).postures()["home"].joints == {"a": 1.0}
    assert Places(arm.host, OPTIONS).choices() == {
        "home": "the robot's own safe posture",
        "retract": "out of the way",
        "wave": "",
        "nod": "nods",
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
    assert caught.value.hint == "There are: home, retract, wave, nod, shelf, above, beside."
    assert arm.calls == []


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        (
            TasksSections(postures={"a": OPTIONS.postures["retract"]}, places={"a": SHELF}),
            "a posture and a place",
        ),
        (
            TasksSections(gestures={"a": OPTIONS.gestures["nod"]}, places={"a": SHELF}),
            "a gesture and a place",
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
    pair = SimpleNamespace(home_rad=None, arms=arms, each_arm=arms, gestures={})
    for module in (moving, named_targets):
        monkeypatch.setattr(module, "profile_of", lambda host: pair)
    arm.move_to("beside")
    assert arm.asked == {"right"}
    assert {call[1]["arm"] for call in arm.calls} == {"right"}
    with pytest.raises(
        InvalidInputError, match="'above' names no arm; the arms are 'left', 'right'"
    ):
        arm.move_to("above")


DOWN = matrix_from_quaternion(np.array([1.0, 0.0, 0.0, 0.0]))


def test_a_position_is_reached_by_a_hand_that_points_down_with_its_present_yaw(arm: Arm) -> None:
    turn = matrix_from_rotvec(np.array([0.0, 0.0, 0.4]))
    arm.rotation = matrix_from_rotvec(np.array([0.2, 0.0, 0.0])) @ turn @ DOWN
    moved = arm.go(position_m=[0.5, 0.2, 0.1])
    assert moved.kind == "position"
    np.testing.assert_allclose(arm.position, [0.5, 0.2, 0.1], atol=0.004)
    np.testing.assert_allclose(arm.rotation @ [0, 0, 1], [0, 0, -1], atol=0.02)
    x_axis = arm.rotation @ [1, 0, 0]
    assert np.arctan2(x_axis[1], x_axis[0]) == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize(
    ("arguments", "rotation"),
    [
        ({"yaw_deg": 30.0}, matrix_from_rotvec(np.array([0.0, 0.0, np.pi / 6])) @ DOWN),
        ({"quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}, np.eye(3)),
    ],
)
def test_yaw_and_quaternion_are_absolute(
    arm: Arm, arguments: dict[str, Any], rotation: Any
) -> None:
    arm.go(position_m=[0.45, 0.0, 0.3], **arguments)
    assert np.linalg.norm(rotvec_from_matrix(rotation @ arm.rotation.T)) < 0.02


def test_a_position_is_approached_from_above(arm: Arm) -> None:
    arm.rotation = DOWN
    arm.go(position_m=[0.5, 0.2, 0.1], above_m=0.15)
    *_, last = [arguments for _, arguments in arm.calls]
    assert last["dz_m"] == pytest.approx(-0.15, abs=0.005)
    assert abs(last["dx_m"]) < 0.005


def test_speed_is_a_fraction_of_the_fastest(arm: Arm) -> None:
    arm.rotation = DOWN
    arm.go(position_m=[0.45, 0.1, 0.3], speed=0.5)
    (_, part), *_ = arm.calls
    assert part["duration_s"] == pytest.approx(0.1 / 0.2 / 0.5)
    arm.calls.clear()
    arm.go(name="home", speed=0.25)
    _, (_, real) = arm.calls
    assert real["duration_s"] == pytest.approx(0.5 / 0.25)


def test_the_hand_goes_over_an_object_by_name_and_by_mark(arm: Arm) -> None:
    arm.rotation = DOWN
    arm.looker = FakeLooker("red", "blue")
    assert arm.go(object="blue").name == "blue cube"
    np.testing.assert_allclose(arm.position, [0.5, 0.0, 0.14], atol=0.004)
    arm.go(mark=1, above_m=0.2)
    np.testing.assert_allclose(arm.position, [0.4, 0.0, 0.24], atol=0.004)


def test_a_marked_object_that_has_gone_is_refused(arm: Arm) -> None:
    arm.looker = FakeLooker("red", drift_m=0.2)
    arm.looker.look("agent")
    with pytest.raises(NotReadyError, match="no longer seen where it was"):
        arm.go(mark=1)
    assert arm.calls == []


@pytest.mark.parametrize(
    ("arguments", "path"),
    [
        ({}, "name"),
        ({"name": "home", "mark": 1}, "name"),
        ({"name": "home", "yaw_deg": 3.0}, "yaw_deg"),
        ({"position_m": [0.4, 0, 0.3], "yaw_deg": 1.0, "quaternion_xyzw": [0, 0, 0, 1]}, "yaw_deg"),
        ({"position_m": [0.4, 0, 0.3], "quaternion_xyzw": [0, 0, 0, 2]}, "quaternion_xyzw"),
        ({"position_m": [0.4, 0, 0.3], "arm": "left"}, "arm"),
        ({"object": "green"}, "object"),
        ({"object": "cube"}, "object"),
    ],
)
def test_targets_that_are_missing_or_ambiguous_move_nothing(
    arm: Arm, arguments: dict[str, Any], path: str
) -> None:
    arm.looker = FakeLooker("red", "blue")
    with pytest.raises(InvalidInputError) as refusal:
        arm.go(**arguments)
    assert refusal.value.path == path
    assert arm.calls == []


def test_what_is_not_seen_is_refused_with_what_helps(arm: Arm) -> None:
    with pytest.raises(NotReadyError, match="sight"):
        arm.go(object="red")
    arm.looker = FakeLooker("red")
    arm.looker.problems = {"above": "Call start_perception first."}
    with pytest.raises(NotReadyError, match="start_perception"):
        arm.go(object="red")
    assert arm.calls == []
