"""The remote backend with served joint policies: requests and answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    ArmState,
    ConfigurationError,
    JointSample,
    Observation,
    Pose,
    UngroundedError,
    UnsafeError,
)

Observe = Callable[..., Observation]
ARM = tuple(f"joint{i}" for i in range(1, 8))
POSTURE = np.linspace(-0.6, 0.6, 7)
DROID = {
    "profile": "droid",
    "joints": ARM,
    "image_keys": {"primary": "observation/exterior_image_1_left"},
}


def _backend(server: Any, **options: Any) -> PolicyBackend:
    backend = PolicyBackend(PolicyOptions(url=server.url, **{**DROID, **options}))
    backend.load()
    return backend


def _seen(observe: Observe, names: tuple[str, ...] = ARM, **changes: Any) -> Observation:
    position = np.array([POSTURE[int(name[-1]) - 1] for name in names])
    joints = JointSample(names=names, position=position)
    return replace(observe(**changes), joints=joints, ee_pose=None)


def _serve(server: Any, row: list[float]) -> None:
    server.answer = lambda request: {"actions": np.tile(np.array(row), (15, 1))}


def test_droid_is_asked_and_answers_in_its_own_terms(policy_server: Any, observe: Observe) -> None:
    _serve(policy_server, [0.1, -0.2, 0, 0, 0, 0, 4.0, 0.25])
    backend = _backend(policy_server)
    chunk = backend.predict(_seen(observe, names=ARM[::-1], gripper_open=0.75))
    request = policy_server.requests[-1]
    np.testing.assert_allclose(request["observation/joint_position"], POSTURE)
    np.testing.assert_allclose(request["observation/gripper_position"], [0.25])
    assert "observation/state" not in request
    # 1 is 3 rad/s and the maximum; in DROID 1 is closed.
    np.testing.assert_allclose(chunk.actions[3], [0.3, -0.6, 0, 0, 0, 0, 3.0, 0.75], atol=1e-12)
    assert chunk.space.kind == "joint_velocity"
    assert chunk.step_s == pytest.approx(1 / 15)
    backend.close()


def test_a_server_has_added_the_state_to_positions(policy_server: Any, observe: Observe) -> None:
    _serve(policy_server, [*POSTURE, 1.0])
    backend = _backend(policy_server, profile="franka")
    chunk = backend.predict(_seen(observe, gripper_open=1.0))
    np.testing.assert_allclose(chunk.actions[0], [*POSTURE, 0.0], atol=1e-12)
    sent = policy_server.requests[-1]["observation/state"]
    np.testing.assert_allclose(sent, [*POSTURE, 0.0])
    backend.close()


def test_a_served_policy_of_two_arms_gets_the_state_of_both(
    policy_server: Any, observe: Observe
) -> None:
    names = tuple(f"{arm}{i}" for arm in ("left", "right") for i in range(6))
    _serve(policy_server, [*np.full(6, 0.1), 0.25, *np.full(6, -0.1), 1.5])
    backend = _backend(
        policy_server, profile="aloha", joints=names, image_keys={"primary": "images.cam_high"}
    )
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    seen = replace(
        observe(),
        joints=JointSample(names=names, position=np.arange(12.0)),
        arms={
            "left": ArmState(ee_pose=pose, gripper_open=0.2),
            "right": ArmState(ee_pose=pose, gripper_open=0.9),
        },
    )
    chunk = backend.predict(seen)
    image = policy_server.requests[-1]["images"]["cam_high"]
    assert (image.dtype, image.shape) == (np.uint8, (3, 224, 224))
    sent = policy_server.requests[-1]["state"]
    np.testing.assert_allclose(sent, [*range(6), 0.2, *range(6, 12), 0.9])
    np.testing.assert_allclose(chunk.actions[0, [0, 6, 7, 13]], [0.1, 0.25, -0.1, 1.0])
    assert chunk.space.keys[13] == "right/gripper_open"
    backend.close()


def test_answers_of_another_width_or_not_finite_are_refused(
    policy_server: Any, observe: Observe
) -> None:
    _serve(policy_server, [0.0] * 7)
    with pytest.raises(ConfigurationError, match=r"\(H >= 1, 8\)"):
        _backend(policy_server)
    _serve(policy_server, [0.0] * 8)
    backend = _backend(policy_server)
    for value in (float("nan"), float("inf"), float("-inf")):
        for row in ([value] + [0.0] * 7, [0.0] * 7 + [value]):  # clipping would hide infinities
            _serve(policy_server, row)
            with pytest.raises(UnsafeError):
                backend.predict(_seen(observe))
    with pytest.raises(UngroundedError, match="joint7"):
        backend.predict(_seen(observe, names=ARM[:6]))
    backend.close()


def test_joints_that_do_not_fit_are_refused(policy_server: Any) -> None:
    with pytest.raises(ConfigurationError, match="'joints' has no effect"):
        _backend(policy_server, profile="libero")
    with pytest.raises(ConfigurationError, match="needs the option 'joints'"):
        _backend(policy_server, joints=None)
    with pytest.raises(ConfigurationError, match="names 6 joints, profile 'droid' has 7"):
        _backend(policy_server, joints=ARM[:6])
    with pytest.raises(ConfigurationError, match="each joint appears once"):
        _backend(policy_server, joints=(*ARM[:6], ARM[0]))
