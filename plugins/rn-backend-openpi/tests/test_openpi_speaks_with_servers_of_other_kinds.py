"""The client with servers of RoboArena's dialect (DreamZero, vLLM-Omni), and the comparison of a
server's metadata with the configuration.

Frames follow the public descriptions: roboarena policy_server.py; vLLM-Omni, "OpenPI Robot Policy
WebSocket API". Two are written byte by byte, so that the packer is not only tested against itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.sync.client import connect

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import REFLEX, Reflex, ReflexOptions, serving
from rn_backend_openpi.description import PROTOCOL, READY, describe_arena, facts_of
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    Channel,
    ConfigurationError,
    ControlSpace,
    JointSample,
    NotReadyError,
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


def _backend(server: Any, **options: Any) -> PolicyBackend:
    given = {"start_timeout_s": 5.0, "timeout_s": 5.0, **ARENA_OPTIONS, **options}
    backend = PolicyBackend(PolicyOptions(url=server.url, **given))
    backend.load()
    return backend


def _seen(observe: Observe) -> Observation:
    return replace(observe(), joints=JointSample(names=ARM, position=np.zeros(7)))


def _rows(width: int = 8) -> Callable[[dict[Any, Any]], dict[str, Any]]:
    return lambda request: {"actions": np.zeros((4, width), dtype=np.float32)}


def test_a_server_with_episodes_gets_endpoint_and_session(
    policy_server: Any, observe: Observe
) -> None:
    def answer(request: dict[Any, Any]) -> Any:
        if request["endpoint"] == "reset":
            return "reset successful"
        return {"actions": np.full((24, 8), 0.5, dtype=np.float32)}

    policy_server.metadata, policy_server.answer = ARENA, answer
    backend = _backend(policy_server)
    chunk = backend.predict(_seen(observe))
    np.testing.assert_allclose(chunk.actions[0], [0.5] * 8)
    assert chunk.space.label.startswith("joint_position@15:joint1,")
    first = policy_server.requests[-1]
    assert first["observation/exterior_image_0_left"].shape == (180, 320, 3)
    assert first["observation/cartesian_position"].shape == (6,)
    backend.reset()
    backend.predict(_seen(observe))
    begun, second = list(policy_server.requests)[-2:]
    assert (first["endpoint"], begun["endpoint"], second["endpoint"]) == ("infer", "reset", "infer")
    assert first["session_id"] != begun["session_id"] == second["session_id"]
    backend.close()


def test_an_array_alone_and_a_map_of_arrays_are_answers(
    policy_server: Any, observe: Observe
) -> None:
    policy_server.metadata, policy_server.answer = METADATA, lambda request: ARRAY
    backend = _backend(policy_server)
    assert policy_server.requests[-1]["endpoint"] == "infer"
    np.testing.assert_array_equal(backend.predict(_seen(observe)).actions, [[1.0] * 7 + [0.0]])
    backend.close()
    # vLLM-Omni with GR00T: arrays by key, with the axis of a batch
    policy_server.answer = lambda request: {
        "gripper_position": np.full((1, 3, 1), 0.25, np.float32),
        "joint_position": np.full((1, 3, 7), 0.5, np.float32),
        "eef_9d": np.zeros((1, 3, 9), np.float32),
    }
    keys = ("joint_position", "gripper_position")
    backend = _backend(policy_server, action_keys=keys)
    np.testing.assert_array_equal(backend.predict(_seen(observe)).actions, [[0.5] * 7 + [0.75]] * 3)
    backend.close()
    with pytest.raises(ConfigurationError, match="no array 'actions'"):
        _backend(policy_server)
    with pytest.raises(ConfigurationError, match=r"expected .* 8"):
        _backend(policy_server, action_keys=("eef_9d",))
    policy_server.answer = lambda request: {
        "joint_position": np.zeros((2, 7)),
        "gripper_position": np.zeros((3, 1)),
    }
    with pytest.raises(ConfigurationError, match="do not fit together"):
        _backend(policy_server, action_keys=keys)


def test_a_map_that_says_error_is_a_failure_of_the_server(
    policy_server: Any, observe: Observe
) -> None:
    policy_server.metadata, policy_server.answer = ARENA, _rows()
    backend = _backend(policy_server)
    policy_server.answer = lambda request: {"type": "error", "message": "Internal inference error"}
    with pytest.raises(NotReadyError, match="Internal inference error"):
        backend.predict(_seen(observe))
    backend.close()


def test_the_server_decides_which_cameras_are_sent(policy_server: Any, observe: Observe) -> None:
    policy_server.metadata, policy_server.answer = ARENA, _rows()
    arena = {"profile": "roboarena", "image_keys": None}
    images = "observation/exterior_image_0_left", "observation/exterior_image_1_left"
    wrist = "observation/wrist_image_left"
    backend = _backend(policy_server, **arena)
    backend.predict(_seen(observe))
    assert policy_server.requests[-1].keys() & {*images, wrist} == {images[0]}
    backend.close()
    policy_server.metadata = {**ARENA, "n_external_cameras": 2, "needs_wrist_camera": True}
    backend = _backend(policy_server, **arena)
    seen = _seen(observe)
    frames = dict.fromkeys(("primary", "secondary", "wrist"), seen.frames["primary"])
    backend.predict(replace(seen, frames=frames))
    assert policy_server.requests[-1].keys() & {*images, wrist} == {*images, wrist}
    del frames["secondary"]
    with pytest.raises(UngroundedError, match="camera role 'secondary'"):
        backend.predict(replace(seen, frames=frames))
    backend.close()


def test_our_server_speaks_roboarenas_dialect(observe: Observe) -> None:
    channels = [Channel(name=name, unit="rad") for name in ARM]
    channels.append(Channel(name="gripper_open", unit="opening"))
    space = ControlSpace(kind="joint_position", channels=tuple(channels), rate_hz=15.0)
    given = {"profile": "roboarena", "joints": ARM}
    model = Reflex(ReflexOptions(step_s=1 / 15), space=space)
    spec = replace(REFLEX, optional_cameras=("wrist", "secondary"))
    with serving(model, spec, interface={"dialect": "roboarena", **given}, space=space) as url:
        with connect(url, compression=None, proxy=None) as plain:
            told = msgpack.unpackb(plain.recv(timeout=10.0))
        assert told == {
            "image_resolution": [224, 224],
            "needs_wrist_camera": True,
            "n_external_cameras": 2,
            "needs_stereo_camera": False,
            "needs_session_id": False,
            "action_space": "joint_position",
        }
        backend = PolicyBackend(PolicyOptions(url=url, **given))
        backend.load()
        seen = _seen(observe)
        frames = dict.fromkeys(("primary", "secondary", "wrist"), seen.frames["primary"])
        backend.reset()
        assert backend.predict(replace(seen, frames=frames)).actions.shape == (4, 8)
        backend.close()
    with pytest.raises(ConfigurationError, match="no name for the action space 'joint_delta'"):
        describe_arena(layout_of(InterfaceOptions(**OWN)))


def test_a_server_without_a_policy_is_shown_in_its_own_words(policy_server: Any) -> None:
    policy_server.metadata = '{"type":"error","error":"Robot policy not available"}'
    with pytest.raises(NotReadyError, match="Robot policy not available"):
        _backend(policy_server)


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
    policy_server: Any, change: dict[str, Any], word: str
) -> None:
    policy_server.metadata, policy_server.answer = {**ARENA, **change}, _rows()
    with pytest.raises(ConfigurationError, match=word):
        _backend(policy_server)
    assert not policy_server.requests


def test_a_size_that_the_server_does_not_take_is_refused(policy_server: Any) -> None:
    policy_server.metadata, policy_server.answer = ARENA, _rows()
    with pytest.raises(ConfigurationError, match=r"180 x 320 .* says 224 x 224"):
        _backend(policy_server, image_size_px=(224, 224))
    _backend(policy_server, image_size_px=(180, 320)).close()


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
    policy_server: Any, theirs: dict[str, Any] | None, word: str
) -> None:
    own: dict[str, Any] = {"protocol": PROTOCOL, "state": READY, "pid": 1}
    if theirs is not None:
        options = {**OWN, **theirs}
        if "profile" in theirs:
            del options["action"], options["state_keys"]
        own["interface"] = facts_of(layout_of(InterfaceOptions(**options)))
    policy_server.metadata, policy_server.answer = {"roboneuron": own}, _rows()
    with pytest.raises(ConfigurationError, match=word):
        _backend(policy_server, **OWN)
    assert not policy_server.requests


def test_a_server_without_ours_facts_needs_a_profile(policy_server: Any) -> None:
    backend = PolicyBackend(PolicyOptions(url=policy_server.url))
    with pytest.raises(ConfigurationError) as caught:
        backend.load()
    assert "libero" in caught.value.hint


def test_a_server_that_sends_no_metadata_is_told_apart(policy_server: Any) -> None:
    policy_server.metadata = None
    released = threading.Event()
    policy_server.greet = lambda connection: released.wait(30.0)
    start = time.monotonic()
    with pytest.raises(NotReadyError, match="accepted the connection, but sends no first"):
        _backend(policy_server, start_timeout_s=0.4)
    assert time.monotonic() - start < 6.0
    released.set()


def test_metadata_that_come_late_are_waited_for(policy_server: Any, observe: Observe) -> None:
    policy_server.answer = _rows()
    policy_server.greet = lambda connection: policy_server.released.wait(0.5)
    backend = _backend(policy_server)
    assert backend.predict(_seen(observe)).metrics["connections"] == 1
    backend.close()


def test_a_connection_that_an_idle_server_closed_costs_no_prediction(
    policy_server: Any, observe: Observe
) -> None:
    policy_server.answer = _rows()
    backend = _backend(policy_server)
    policy_server.connection.close(code=1001, reason="idle")
    policy_server.connection.recv_events_thread.join(5.0)
    assert backend.predict(_seen(observe)).metrics["connections"] == 2
    backend.close()
