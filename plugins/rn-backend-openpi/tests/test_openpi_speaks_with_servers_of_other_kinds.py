"""The client with servers of RoboArena's dialect (DreamZero, vLLM-Omni), and the comparison of a
server's metadata with the configuration.

Frames follow the public descriptions: roboarena policy_server.py; vLLM-Omni, "OpenPI Robot Policy
WebSocket API". Two are written byte by byte, so that the packer is not only tested against itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from foreign_engines import ScriptedServer
from openpi_clients import loaded, open_client

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import REFLEX, Reflex, ReflexOptions, serving
from rn_backend_openpi.description import PROTOCOL, READY, describe_arena, facts_of
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    ConfigurationError,
    JointSample,
    Observation,
    UngroundedError,
)

Observe = Callable[..., Observation]
ARM = tuple(f"joint{i}" for i in range(1, 8))
ARENA = {
    "image_resolution": [180, 320],
    "n_external_cameras": 1,
    "needs_wrist_camera": False,
    "needs_stereo_camera": False,
    "needs_session_id": True,
    "action_space": "joint_position",
}
"""Metadata of DreamZero, with one camera."""
ARENA_OPTIONS = {
    "profile": "roboarena",
    "joints": ARM,
    "image_keys": {"primary": "observation/exterior_image_0_left"},
}
METADATA = bytes.fromhex(
    "82" + "b06e6565" + "64735f73657373696f6e5f6964" + "c3"  # "needs_session_id": true
    "ac616374696f6e5f7370616365" + "ae6a6f696e745f706f736974696f6e"  # "action_space": ...
)
ARRAY = bytes.fromhex(
    "84"
    "c40b5f5f6e6461727261795f5f" + "c3"  # b"__ndarray__": true
    "c40464617461"
    + "c420"
    + "0000803f" * 8  # b"data": eight float32 of 1.0
    + "c4056474797065"
    + "a33c6634"  # b"dtype": "<f4"
    "c4057368617065" + "920108"  # b"shape": [1, 8]
)
"""A reply that is an array instead of a map."""


def _options(server: ScriptedServer, **options: Any) -> PolicyOptions:
    given = {"start_timeout_s": 5.0, "timeout_s": 5.0, **ARENA_OPTIONS, **options}
    return PolicyOptions(url=server.url, **given)


def _refused(server: ScriptedServer, word: str, **options: Any) -> None:
    with pytest.raises(ConfigurationError, match=word):
        PolicyBackend(_options(server, **options)).load()


def _seen(observe: Observe, *roles: str) -> Observation:
    made = replace(observe(), joints=JointSample(names=ARM, position=np.zeros(7)))
    return replace(made, frames=dict.fromkeys(("primary", *roles), made.frames["primary"]))


def _rows(request: dict[Any, Any]) -> Any:
    if request.get("endpoint") == "reset":
        return "reset successful"
    return {"actions": np.full((4, 8), 0.5, dtype=np.float32)}


@pytest.fixture
def arena(policy_server: ScriptedServer) -> ScriptedServer:
    """A server with episodes."""
    policy_server.told, policy_server.reply = ARENA, _rows
    return policy_server


def test_a_server_with_episodes_gets_endpoint_and_session(
    arena: ScriptedServer, observe: Observe
) -> None:
    with loaded(_options(arena)) as backend:
        chunk = backend.predict(_seen(observe))
        np.testing.assert_allclose(chunk.actions[0], [0.5] * 8)
        assert chunk.space.label.startswith("joint_position@15:joint1,")
        first = arena.requests[-1]
        assert first["observation/exterior_image_0_left"].shape == (180, 320, 3)
        assert first["observation/cartesian_position"].shape == (6,)
        backend.reset()
        backend.predict(_seen(observe))
    begun, second = list(arena.requests)[-2:]
    assert (first["endpoint"], begun["endpoint"], second["endpoint"]) == ("infer", "reset", "infer")
    assert first["session_id"] != begun["session_id"] == second["session_id"]


def test_an_array_alone_and_a_map_of_arrays_are_answers(
    policy_server: ScriptedServer, observe: Observe
) -> None:
    # vLLM-Omni with GR00T: arrays by key, with the axis of a batch
    parts = {
        "gripper_position": np.full((1, 3, 1), 0.25, np.float32),
        "joint_position": np.full((1, 3, 7), 0.5, np.float32),
        "eef_9d": np.zeros((1, 3, 9), np.float32),
    }
    keys = ("joint_position", "gripper_position")
    policy_server.told = METADATA
    for reply, options, rows in (
        (ARRAY, {}, [[1.0] * 7 + [0.0]]),
        (parts, {"action_keys": keys}, [[0.5] * 7 + [0.75]] * 3),
    ):
        policy_server.reply = lambda request, reply=reply: reply  # type: ignore[misc]
        with loaded(_options(policy_server, **options)) as backend:
            np.testing.assert_array_equal(backend.predict(_seen(observe)).actions, rows)
        assert policy_server.requests[-1]["endpoint"] == "infer"
    _refused(policy_server, "no array 'actions'")
    _refused(policy_server, r"expected .* 8", action_keys=("eef_9d",))
    parts["gripper_position"] = np.zeros((4, 1))
    _refused(policy_server, "do not fit together", action_keys=keys)


@pytest.mark.parametrize(("external", "wrist"), [(1, False), (2, True)])
def test_the_server_decides_which_cameras_are_sent(
    arena: ScriptedServer, observe: Observe, external: int, wrist: bool
) -> None:
    arena.told = {**ARENA, "n_external_cameras": external, "needs_wrist_camera": wrist}
    images = ["observation/exterior_image_0_left", "observation/exterior_image_1_left"][:external]
    images += ["observation/wrist_image_left"] * wrist
    with loaded(_options(arena, image_keys=None)) as backend:
        backend.predict(_seen(observe, "secondary", "wrist"))
        sent = {key for key in arena.requests[-1] if "image" in key}
        assert sent == set(images)
        if wrist:
            with pytest.raises(UngroundedError, match="camera role 'secondary'"):
                backend.predict(_seen(observe, "wrist"))


def test_our_server_speaks_roboarenas_dialect(observe: Observe) -> None:
    given = {"profile": "roboarena", "joints": ARM}
    space = layout_of(InterfaceOptions(**given)).rows.space
    model = Reflex(ReflexOptions(step_s=1 / 15), space=space)
    spec = replace(REFLEX, optional_cameras=("wrist", "secondary"))
    with serving(model, spec, interface={"dialect": "roboarena", **given}, space=space) as url:
        with open_client(url) as plain:
            assert plain.metadata == {
                "image_resolution": [224, 224],
                "needs_wrist_camera": True,
                "n_external_cameras": 2,
                "needs_stereo_camera": False,
                "needs_session_id": False,
                "action_space": "joint_position",
            }
        with loaded(PolicyOptions(url=url, **given)) as backend:
            backend.reset()
            seen = _seen(observe, "secondary", "wrist")
            assert backend.predict(seen).actions.shape == (4, 8)
    with pytest.raises(ConfigurationError, match="no name for the action space 'joint_delta'"):
        describe_arena(layout_of(InterfaceOptions(**OWN)))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"action_space": "joint_velocity"}, "'joint_velocity', the configuration says 'joint_pos"),
        ({"action_space": "cartesian_velocity"}, "'cartesian_velocity', the configuration"),
        ({"action_space": "ee_pose"}, "'ee_pose', the configuration says 'joint_position'"),
        ({"n_external_cameras": 2}, r"needs 2 external cameras \(image_keys has 1\)"),
        ({"needs_wrist_camera": True}, "needs a wrist camera"),
        ({"needs_stereo_camera": True}, "needs both images"),
        ({"image_resolution": [0, 4]}, "image_resolution is"),
    ],
)
def test_metadata_that_disagree_are_refused_by_name(
    arena: ScriptedServer, change: dict[str, Any], word: str
) -> None:
    arena.told = {**ARENA, **change}
    _refused(arena, word)
    assert not arena.requests


def test_a_size_that_the_server_does_not_take_is_refused(arena: ScriptedServer) -> None:
    _refused(arena, r"180 x 320 .* says 224 x 224", image_size_px=(224, 224))
    with loaded(_options(arena, image_size_px=(180, 320))):
        assert arena.requests


OWN = {
    "profile": "own",
    "action": {"kind": "joint_delta", "gripper": "open_fraction", "rate_hz": 15.0},
    "state_keys": {"state": ["joints"]},
    "joints": ARM,
    "image_keys": {"primary": "observation/image"},
}


@pytest.mark.parametrize(
    ("theirs", "word"),
    [
        ({"profile": "droid-position"}, "profile is 'droid-position' at the server, 'own' in"),
        ({"action": {**OWN["action"], "kind": "joint_velocity"}}, "'joint_velocity@15:"),
        ({"action": {**OWN["action"], "rate_hz": 10.0}}, "@10:"),
        ({"joints": ARM[::-1]}, "joint7,joint6"),
        ({"image_keys": {"primary": "rgb"}}, "the key of the camera 'primary' is 'rgb' at"),
        ({"image_axes": "chw"}, "image_axes is 'chw' at the server"),
        ({"prompt_key": "task"}, "prompt_key is 'task' at the server"),
        (None, "has no `interface`"),
    ],
)
def test_a_roboneuron_server_with_another_interface_is_refused_by_name(
    policy_server: ScriptedServer, theirs: dict[str, Any] | None, word: str
) -> None:
    own: dict[str, Any] = {"protocol": PROTOCOL, "state": READY, "pid": 1}
    if theirs is not None:
        options = {**OWN, **theirs}
        if "profile" in theirs:
            del options["action"], options["state_keys"]
        own["interface"] = facts_of(layout_of(InterfaceOptions(**options)))
    policy_server.told = {"roboneuron": own}
    _refused(policy_server, word, **OWN)
    assert not policy_server.requests


def test_a_server_without_our_facts_needs_a_profile(policy_server: ScriptedServer) -> None:
    with pytest.raises(ConfigurationError) as caught:
        PolicyBackend(PolicyOptions(url=policy_server.url)).load()
    assert "libero" in caught.value.hint
