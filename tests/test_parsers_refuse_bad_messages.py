"""No parser of messages from outside raises anything but a deliberate error, whatever it is given.

`python tools/parsers.py 100000` prints a table.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from rn_backend_openpi import wire as openpi_wire
from rn_backend_shared import frames, wire
from rn_backend_shared.frames import FrameKind, Header
from rn_backend_shared.introduction import to_profile
from rn_backend_shared.session import Welcome
from rn_eval import wire as eval_wire
from rn_link_pairing.pake import PairingError
from rn_link_pairing.wire import parse
from rn_recorder_runs.store import decoded_event
from rn_runtime_sglang.wire import MalformedReply, error_text, parse_reply
from rn_simulation.scene_state import from_message
from rn_standard.tasks.http_judge import parse_answer
from rn_testing.bad_data import ESCAPED, NOTHING, Parser, tried
from rn_view.teleoperation.sample_socket import PageTeleoperator
from rn_view.visualization.predicted_path import PlannedChunk
from roboneuron import EE_DELTA, ForeignDataError, RoboNeuronError, foreign

POSE = [{"$array": 2}, {"$array": 3}, 5]
OBSERVATION = {
    "frames": {},
    "instruction": "pick",
    "joints": [["j1"], {"$array": 0}, None, 1],
    "ee_pose": None,
    "gripper_open": 0.5,
    "arms": {"left": [POSE, 0.5]},
    "ahead": {
        "rows": {"$array": 1},
        "committed_rows": 1,
        "step_s": 0.1,
        "context": [1, 2],
        "context_row": 0,
        "state_ahead_s": 0.0,
    },
    "stamp_ns": 7,
}
SPACE = wire.from_space(EE_DELTA)
ANSWER = {
    "actions": {"$array": 1},
    "space": SPACE,
    "step_s": 0.1,
    "note": "",
    "metrics": [["a"], {"$array": 0}],
    "context": None,
    "conditioned_rows": 0,
}
WELCOME = {
    "state": "ready",
    "pid": 5,
    "cameras": ["primary"],
    "optional_cameras": [],
    "horizon": 4,
    "step_s": 0.1,
    "most_committed": 2,
    "takes_state": False,
    "continues": True,
    "crops": {"a": [0, 0, 4, 4]},
    "image_sizes": {"a": [4, 4]},
    "space": SPACE,
}
ROBOT = {
    "name": "fr3",
    "base_link": "a",
    "tcp_link": "b",
    "arm_joints": ["j1"],
    "slides": [],
    "gripper": ["f", 0.0, 0.04],
    "arms": [["l", ["j1"], "a", "b", None]],
    "cameras": [["c", "primary", 4, 4]],
}
ARRAYS = [["<f8", [1]], ["<f8", [1, 7]], ["<f8", [3]], ["<f8", [4]]]
BODY = np.array([0.0] * 14 + [1.0]).tobytes()


def framed(take: Callable[[Any], object]) -> Callable[[Path, bytes], object]:
    """Decode a document in a frame of version 5, with its arrays after it."""

    def parse(folder: Path, data: bytes) -> object:
        body = b"[" + data + b"," + json.dumps(ARRAYS).encode() + b"]"
        header = Header(FrameKind.REQUEST, document_bytes=len(body), array_bytes=len(BODY))
        return take(frames.decode(header, body + BODY))

    return parse


def of_json(take: Callable[[Any], object]) -> Callable[[Path, bytes], object]:
    return lambda folder, data: take(foreign.decode_json(data, "it"))


def page_sample(folder: Path, data: bytes) -> None:
    page = PageTeleoperator()
    try:
        told = foreign.table(foreign.decode_json(data, "it"), "it", 16)
    except ForeignDataError:
        told = {}
    page.put(told, 1.0)
    page.read(0.0)


class SceneMessage:
    """Stands in for std_msgs/Float64MultiArray."""

    def __init__(self, data: bytes) -> None:
        text = data.decode("utf-8", "replace")
        self.layout = type("L", (), {"dim": [type("D", (), {"label": text})()]})()
        self.data = [1.0, 2.0, *[0.0] * 8]


def packed(valid: object) -> bytes:
    return bytes(msgpack.packb(valid, use_bin_type=True))


SCENE = {"robot": "fr3", "engine": "pybullet", "seed": 3, "cubes": [["red", 0.04]]}
PARSERS = {
    "page samples": Parser(
        "a browser",
        page_sample,
        {
            "t": 1.5,
            "n": 4,
            "held": True,
            "twist": [0, 0, 0, 0, 0, 0.5],
            "tool": False,
            "grip": 0.5,
        },
        (ForeignDataError, RoboNeuronError),
    ),
    "page samples, joint": Parser(
        "a browser", page_sample, {"t": 1, "n": 4, "joint": ["j1", 0.1]}, (RoboNeuronError,)
    ),
    "frames": Parser(
        "a robot or policy server", framed(lambda document: document), {}, (ForeignDataError,)
    ),
    "observation": Parser(
        "a robot", framed(lambda d: wire.to_observation(d)), OBSERVATION, (RoboNeuronError,)
    ),
    "answer": Parser("a policy server", framed(wire.to_answer), ANSWER, (RoboNeuronError,)),
    "introduction": Parser("a robot", of_json(to_profile), ROBOT, (RoboNeuronError,)),
    "welcome": Parser(
        "a policy server",
        of_json(lambda d: Welcome.of(foreign.table(d, "it"))),
        WELCOME,
        (ForeignDataError,),
    ),
    "openpi": Parser(
        "openpi's clients and servers",
        lambda folder, data: openpi_wire.unpack(data),
        packed({"prompt": "x", "state": [1.0, 2], "n": {"a": [1, None, True]}}),
        (ForeignDataError,),
    ),
    "openpi, arrays": Parser(
        "openpi's clients and servers",
        lambda folder, data: openpi_wire.unpack(data),
        openpi_wire.pack({"state": np.zeros(3), "one": np.float32(1)}),
        (ForeignDataError,),
    ),
    "vla-eval": Parser(
        "vla-eval's clients",
        lambda folder, data: eval_wire.unpack(data),
        eval_wire.pack(eval_wire.WireMessage("hello", {"a": np.zeros(3)}, 1)),
        (ForeignDataError,),
    ),
    "SGLang, reply": Parser(
        "SGLang",
        lambda folder, data: parse_reply(data, "it", rid="r", count=1, vocabulary=9),
        {"output_ids": [3], "meta_info": {"id": "r", "finish_reason": {"type": "length"}}},
        (MalformedReply, RoboNeuronError),
    ),
    "SGLang, error": Parser(
        "SGLang", lambda folder, data: error_text(data), {"error": {"message": "x"}}, NOTHING
    ),
    "judge": Parser(
        "an HTTP endpoint",
        lambda folder, data: parse_answer(data),
        {"success": 0.5, "progress": 1, "failure": None, "reason": "x"},
        (ForeignDataError,),
    ),
    "scene": Parser(
        "a ROS node",
        lambda folder, data: from_message(SceneMessage(data), {"fr3": 1}),
        SCENE,
        (RoboNeuronError,),
    ),
    "prediction": Parser(
        "a ROS node",
        lambda folder, data: PlannedChunk.parse(data.decode("utf-8", "replace"), 0.0),
        {
            "space": "ee_pose:x,y",
            "rows": [[1, 2]],
            "step_s": 0.1,
            "arms": {"l": {"position_m": [0, 0, 0]}},
            "joints": {"names": ["a"], "position": [1.0]},
        },
        NOTHING,
    ),
    "pairing": Parser(
        "another machine",
        lambda folder, data: parse(data, "a", "b"),
        {"a": "x", "b": "y"},
        (PairingError,),
    ),
    "recorded event": Parser(
        "a recording",
        lambda folder, data: decoded_event(data.decode("utf-8", "replace")),
        {"at_ns": 5, "what": "call", "arguments": {"a": [1]}},
        (ForeignDataError,),
    ),
}


@pytest.mark.parametrize("name", PARSERS)
def test_nothing_but_a_deliberate_error_escapes(name: str, tmp_path: Path) -> None:
    found = tried(PARSERS[name], 300, tmp_path)
    assert not [text for text in found if text.startswith(ESCAPED)]
    assert sum(found.values()) == 300


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_nothing_escapes_of_many_inputs(name: str, tmp_path: Path) -> None:
    found = tried(PARSERS[name], 100_000, tmp_path, seed=7)
    assert not [text for text in found if text.startswith(ESCAPED)]


@pytest.mark.parametrize("name", PARSERS)
def test_the_valid_document_is_taken(name: str, tmp_path: Path) -> None:
    """Otherwise the mutations would be far from what is parsed."""
    parser = PARSERS[name]
    data = parser.valid if isinstance(parser.valid, bytes) else json.dumps(parser.valid).encode()
    parser.parse(tmp_path, data)
