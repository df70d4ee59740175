"""No parser of messages from outside raises anything but a deliberate error, whatever it is given.

`python tools/parsers.py 100000` prints a table.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from PIL import Image
from sensor_msgs.msg import CompressedImage

from rn_backend_openpi import messages
from rn_backend_openpi import wire as openpi_wire
from rn_backend_openpi.description import ServerDescription
from rn_backend_openpi.introduction import to_profile
from rn_eval import wire as eval_wire
from rn_link import rtps
from rn_link.pairing import PairingError, parse
from rn_recorder_runs.action_labels import label_of
from rn_recorder_runs.episodes import stamp_of
from rn_recorder_runs.images import to_jpeg
from rn_recorder_runs.store import decoded_event
from rn_robot_fr3.fci.network_check import is_answer
from rn_runtime_sglang.wire import MalformedReply, error_text, parse_reply
from rn_simulation.scene_state import from_message
from rn_standard.tasks.http_judge import parse_answer
from rn_testing.bad_data import ESCAPED, NOTHING, Parser, tried
from rn_view.diagnostics.active_limits import limit_counts
from rn_view.teleoperation.sample_socket import PageTeleoperator
from rn_view.visualization.predicted_path import PlannedChunk
from roboneuron import EE_DELTA, ForeignDataError, RoboNeuronError, foreign
from roboneuron.switching.standby import LISTENERS, listeners
from roboneuron.tools.ros.interfaces.picture import to_picture

REQUEST = {
    "prompt": "pick",
    "observation/image": np.zeros((4, 4, 3), np.uint8),
    "observation/joint_names": ["j1"],
    "observation/joint_position": np.zeros(1),
    "observation/left/ee_pose": np.array([0.0] * 6 + [1.0]),
    "observation/gripper_open": np.array([0.5]),
    "roboneuron": {
        "frames": {"primary": {"camera": "c", "stamp_ns": 5, "frame_id": "f"}},
        "arm_stamps_ns": {"left": 5},
        "ahead": {
            "rows": np.zeros((1, 7)),
            "committed_rows": 1,
            "step_s": 0.1,
            "context": [1, 2],
            "context_row": 0,
            "state_ahead_s": 0.0,
        },
        "stamp_ns": 7,
    },
}
SPACE = messages.from_space(EE_DELTA)
ANSWER = {
    "actions": np.zeros((1, 7)),
    "step_s": 0.1,
    "roboneuron": {
        "space": SPACE,
        "note": "",
        "metrics": [["a"], np.zeros(1)],
        "context": None,
        "conditioned_rows": 0,
    },
}
WELCOME = {
    "protocol": 1,
    "number": 5,
    "state": "ready",
    "pid": 5,
    "cameras": ["primary"],
    "optional_cameras": [],
    "horizon": 4,
    "step_s": 0.1,
    "most_committed": 2,
    "takes_state": False,
    "continues": True,
    "image_sizes": {"a": [4, 4]},
    "interface": {"profile": "libero"},
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


def of_message(take: Callable[[Any], object]) -> Callable[[Path, bytes], object]:
    """Decode a message of a websocket."""
    return lambda folder, data: take(openpi_wire.unpack(data))


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


def png(pixels: int = 8) -> bytes:
    """A grey PNG of that height and width, whose data are those of 8 x 8."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    head = struct.pack(">IIBBBBB", pixels, pixels, 8, 0, 0, 0, 0)
    rows = zlib.compress(bytes(9 * 8))
    signature = b"\x89PNG\r\n\x1a\n"
    return signature + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg() -> bytes:
    made = io.BytesIO()
    Image.fromarray(np.zeros((16, 16, 3), dtype=np.uint8)).save(made, "JPEG")
    return made.getvalue()


def shown(folder: Path, data: bytes) -> object:
    message = CompressedImage(format="png")
    message.data = data
    return to_picture(message, longest_side_px=64)


def eval_image(folder: Path, data: bytes) -> object:
    payload = {"a": {"__image__": True, "format": "png", "data": data}}
    raw = {"type": "hello", "payload": payload, "seq": 1, "timestamp": 1.0}
    return eval_wire.unpack(packed(raw))


CDR_IMAGE = (
    struct.pack("<4siII4s", b"\0\1\0\0", 1, 2, 2, b"a\0\0\0")
    + struct.pack("<III8s", 4, 4, 5, b"rgb8\0\0\0\0")
    + struct.pack("<II", 12, 48)
    + bytes(48)
)
DISCOVERY = b"RTPS\2\3\1\x0f" + bytes(12) + b"\x15\5\x20\0\0\0\x10\0\0\0\0\0\0\1\0\xc2" + bytes(24)
PLACES = {7400: (b"\1\2\3\4", 5)}
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
    "observation": Parser(
        "a robot",
        of_message(messages.to_observation),
        openpi_wire.pack(REQUEST),
        (RoboNeuronError,),
    ),
    "answer": Parser(
        "a policy server",
        of_message(messages.to_answer),
        openpi_wire.pack(ANSWER),
        (RoboNeuronError,),
    ),
    "introduction": Parser("a robot", of_json(to_profile), ROBOT, (RoboNeuronError,)),
    "welcome": Parser(
        "a policy server",
        of_json(lambda d: ServerDescription.of({messages.RESERVED: d})),
        WELCOME,
        (RoboNeuronError,),
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
    "shown PNG": Parser("a ROS node", shown, png(), (RoboNeuronError,)),
    "shown JPEG": Parser("a ROS node", shown, jpeg(), (RoboNeuronError,)),
    "vla-eval, PNG": Parser("vla-eval's clients", eval_image, png(), (ForeignDataError,)),
    "recorded image": Parser(
        "a ROS node", lambda folder, data: to_jpeg(data, 80), CDR_IMAGE, (ValueError,)
    ),
    "recorded stamp": Parser(
        "a recording", lambda folder, data: stamp_of(data), CDR_IMAGE[:12], (ForeignDataError,)
    ),
    "recorded label": Parser("a ROS node", lambda folder, data: label_of(data), CDR_IMAGE, NOTHING),
    "discovery": Parser(
        "the network",
        lambda folder, data: (rtps.read_announcement(data), rtps.with_places(data, PLACES)),
        DISCOVERY,
        NOTHING,
    ),
    "echo": Parser(
        "a control box", lambda folder, data: is_answer(data, 5), bytes(7) + b"\5", NOTHING
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


@pytest.mark.parametrize("pixels", [10_000, 20_000, 2**16, 2**31 - 1])
@pytest.mark.parametrize("name", ["shown PNG", "vla-eval, PNG"])
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_small_file_of_a_large_picture_is_refused(name: str, pixels: int, tmp_path: Path) -> None:
    parser = PARSERS[name]
    with pytest.raises(parser.errors):
        parser.parse(tmp_path, png(pixels))


@pytest.mark.parametrize("read", [listeners, limit_counts])
@pytest.mark.parametrize("text", ["", "x", "-1", "1.5", "nan", "1e9", "9" * 5000, "\u00b2", " 1"])
def test_what_a_node_reports_as_a_count_may_be_anything(
    read: Callable[[dict[str, str]], object], text: str
) -> None:
    prefix = LISTENERS if read is listeners else "limited."
    assert read({f"{prefix}a": text, f"{prefix}b": "7", "c": "8"}) == {"b": 7}
