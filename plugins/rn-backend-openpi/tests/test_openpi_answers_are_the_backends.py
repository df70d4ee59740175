"""The client receives the backend's answers: bit-identical in each of the five spaces, within
rounding for the public profiles.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import REFLEX, Reflex, ReflexOptions, serving
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    EE_DELTA,
    ArmState,
    Channel,
    ControlSpace,
    Frame,
    JointSample,
    NotReadyError,
    Observation,
    Pose,
    UngroundedError,
)

Observe = Callable[..., Observation]
ARM = tuple(f"joint{i}" for i in range(1, 8))
PAIR = tuple(f"{arm}{i}" for arm in ("left", "right") for i in range(6))


def _joints(
    kind: str, names: tuple[str, ...], rate_hz: float, arms: tuple[str, ...] = ("",)
) -> Any:
    unit = "rad/s" if kind == "joint_velocity" else "rad"
    each = len(names) // len(arms)
    channels: list[Channel] = []
    for i, arm in enumerate(arms):
        part = names[i * each : (i + 1) * each]
        channels += [Channel(name=name, unit=unit, arm=arm) for name in part]
        channels.append(Channel(name="gripper_open", unit="opening", arm=arm))
    return ControlSpace(kind=kind, channels=tuple(channels), rate_hz=rate_hz)


def _poses(arms: tuple[str, ...]) -> ControlSpace:
    channels: list[Channel] = []
    for arm in arms:
        channels += [Channel(name=x, unit="m", frame="base", arm=arm) for x in "xyz"]
        channels += [Channel(name=f"q{x}", unit="1", frame="base", arm=arm) for x in "xyzw"]
        channels.append(Channel(name="gripper_open", unit="opening", arm=arm))
    return ControlSpace(kind="ee_pose", channels=tuple(channels), rate_hz=10.0)


SPACES: dict[str, ControlSpace] = {
    "ee_delta": EE_DELTA,
    "ee_pose": _poses(("",)),
    "ee_pose of two arms": _poses(("left", "right")),
    "joint_position": _joints("joint_position", PAIR, 50.0, ("left", "right")),
    "joint_velocity": _joints("joint_velocity", ARM, 15.0),
    "joint_delta": _joints("joint_delta", ARM, 20.0),
}


def _seen(observe: Observe, names: tuple[str, ...] = ARM) -> Observation:
    pose = Pose(position_m=np.array([0.4, 0.1, 0.2]), quaternion_xyzw=np.array([1.0, 0, 0, 0]))
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, (90, 160, 3), dtype=np.uint8)
    return replace(
        observe(),
        frames={"primary": Frame(camera="c", image=image, stamp_ns=1, frame_id="c")},
        joints=JointSample(names=names, position=rng.standard_normal(len(names))),
        arms={name: ArmState(ee_pose=pose, gripper_open=0.3) for name in ("left", "right")},
    )


def _asked(url: str, options: dict[str, Any], seen: Observation) -> Any:
    backend = PolicyBackend(PolicyOptions(url=url, timeout_s=20.0, **options))
    backend.load()
    try:
        return backend.predict(seen)
    finally:
        backend.close()


@pytest.mark.parametrize("name", SPACES)
def test_rows_of_every_space_are_those_of_the_backend_to_the_bit(
    name: str, observe: Observe
) -> None:
    space = SPACES[name]
    model = Reflex(ReflexOptions(step_s=1.0 / (space.rate_hz or 8.0)), space=space)
    seen = _seen(observe)
    with serving(model, space=space) as url:
        chunk = _asked(url, {"coding": "raw"}, seen)
    local = model.predict(seen)
    assert chunk.actions.tobytes() == local.actions.tobytes()
    assert (chunk.space, chunk.step_s) == (space, local.step_s)
    assert chunk.metrics["shared.model_ms"] >= 0.0


PUBLIC: dict[str, tuple[ControlSpace, tuple[str, ...]]] = {
    "libero": (EE_DELTA, ()),
    "bridge": (EE_DELTA, ()),
    "droid": (_joints("joint_velocity", ARM, 15.0), ARM),
    "droid-position": (_joints("joint_position", ARM, 15.0), ARM),
    "roboarena": (_joints("joint_position", ARM, 15.0), ARM),
    "franka": (_joints("joint_position", ARM, 20.0), ARM),
    "ur5e": (_joints("joint_position", ARM[:6], 20.0), ARM[:6]),
    "aloha": (_joints("joint_position", PAIR, 50.0, ("left", "right")), PAIR),
}
STEPS = {"libero": 0.05, "bridge": 0.2}


@pytest.mark.parametrize("profile", PUBLIC)
def test_rows_behind_a_public_profile_are_those_of_the_backend(
    profile: str, observe: Observe
) -> None:
    space, joints = PUBLIC[profile]
    keys = {"primary": "images.top"}
    options = {"profile": profile, "image_keys": keys, "image_size_px": "raw"}
    if joints:
        options["joints"] = joints
    own = ReflexOptions(step_s=STEPS.get(profile) or 1.0 / space.rate_hz, sees_hand=False)
    model = Reflex(own, space=space)
    seen = _seen(observe, joints or ARM)
    if not joints:
        seen = replace(seen, joints=None)
    with serving(model, interface=options, space=space) as url:
        chunk = _asked(url, options, seen)
    local = model.predict(seen).actions
    # scales and openings are multiplied once in each direction
    np.testing.assert_allclose(chunk.actions, local, atol=1e-14, rtol=0)
    assert chunk.space == space


def test_robots_that_ask_at_the_same_time_get_their_own_answers(observe: Observe) -> None:
    model, answers = Reflex(), dict[int, Any]()

    def ask(number: int) -> None:
        seen = replace(_seen(observe), instruction="x" * (number + 1))
        answers[number] = (
            _asked(url, {"coding": "raw"}, seen).actions,
            model.predict(seen).actions,
        )

    with serving(model) as url:
        threads = [threading.Thread(target=ask, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
    assert len(answers) == 8
    assert all(got.tobytes() == own.tobytes() for got, own in answers.values())


class Late(Reflex):
    """Answers too late."""

    def predict(self, observation: Observation) -> Any:
        raise NotReadyError("not now")


def test_what_the_backend_says_of_an_observation_reaches_the_robot(observe: Observe) -> None:
    with serving(Late()) as url:
        backend = PolicyBackend(PolicyOptions(url=url))
        backend.load()
        with pytest.raises(NotReadyError, match=r"^not now"):
            backend.predict(_seen(observe))
        backend.close()


def test_a_camera_that_the_backend_needs_is_asked_for(observe: Observe) -> None:
    spec = replace(REFLEX, cameras=("primary", "wrist"), optional_cameras=())
    with serving(Reflex(), spec) as url:
        backend = PolicyBackend(PolicyOptions(url=url))
        backend.load()
        with pytest.raises(UngroundedError, match="'wrist'"):
            backend.predict(_seen(observe))
        backend.close()
