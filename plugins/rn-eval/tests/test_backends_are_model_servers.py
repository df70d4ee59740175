"""A backend serves vla-eval's clients: handshake, one action per observation, errors; the
conventions of LIBERO.

The first tests use only msgpack and websockets; the last one uses vla-eval's own client and episode
runner, in its own environment (`make interop-vla-eval`).
"""

from __future__ import annotations

import asyncio
import io
import os
import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import msgpack
import numpy as np
import pytest
from PIL import Image
from websockets.asyncio.client import connect

from rn_eval import bridge, wire
from rn_eval.model_server import EvalModelServer, open_server
from roboneuron import (
    ActionChunk,
    InvalidInputError,
    UngroundedError,
    matrix_from_quaternion,
    rotvec_from_matrix,
)

ROOT = Path(__file__).parents[3]
VLA_EVAL = Path(os.environ.get("ROBONEURON_VLA_EVAL_PYTHON", ROOT / ".venv-vla-eval/bin/python"))
STATE = np.array([0.1, 0.2, 1.1, 3.5, 0.1, -0.05, 0.0387, -0.0388])


class Policy:
    def __init__(self):
        self.seen, self.resets = [], 0

    def predict(self, observation):
        if observation.instruction == "refuse":
            raise UngroundedError("Nothing to see.")
        self.seen.append(observation)
        rows = np.zeros((3, 7))
        rows[:, 0], rows[:, 5], rows[:, 6] = 0.05 * np.arange(3), 0.25, 1.0
        return ActionChunk(actions=rows, step_s=0.05)

    def reset(self):
        self.resets += 1

    def close(self):
        pass


def image(value):
    buffer = io.BytesIO()
    Image.fromarray(np.full((8, 8, 3), value, np.uint8)).save(buffer, format="PNG")
    return {"__image__": True, "format": "png", "data": buffer.getvalue(), "shape": [8, 8, 3]}


def observed(**changes):
    state = {"__ndarray__": True, "data": STATE.tobytes(), "dtype": "<f8", "shape": [8]}
    return {
        "images": {"agentview": image(7), "wrist": image(9)},
        "task_description": "go",
        "states": state,
    } | changes


def talk(messages, policy):
    """Send each (type, payload) in turn; return the answers to those that have one."""

    async def run():
        server = EvalModelServer(policy, name="toy", roles=("primary", "wrist"), needs_state=True)
        async with await open_server(server, "127.0.0.1", 0) as opened:
            port = opened.sockets[0].getsockname()[1]
            health = await asyncio.to_thread(
                urllib.request.urlopen, f"http://127.0.0.1:{port}/health", timeout=30
            )
            with health:
                assert health.read() == b'{"status": "ok"}\n'
            answers = []
            async with connect(f"ws://127.0.0.1:{port}", compression=None) as client:
                for seq, (kind, payload) in enumerate(messages, 1):
                    await client.send(
                        msgpack.packb(
                            {"type": kind, "payload": payload, "seq": seq, "timestamp": 0.0}
                        )
                    )
                    if kind in ("hello", "observation", "nonsense"):
                        answers.append(wire.unpack(await asyncio.wait_for(client.recv(), 30)))
            return answers

    return asyncio.run(run())


def test_an_episode_is_served():
    policy = Policy()
    hello, *actions = talk(
        [("hello", {}), ("episode_start", {"task": {}})] + [("observation", observed())] * 4, policy
    )
    assert (hello.kind, hello.seq, hello.payload["protocol_version"]) == ("hello", 1, 1)
    assert hello.payload["observation_params"]["send_wrist_image"] is True
    assert [a.seq for a in actions] == [3, 4, 5, 6]
    played = np.array([a.payload["actions"] for a in actions])
    assert played.dtype == np.float32
    # the chunk is used up before the next one
    np.testing.assert_allclose(played[:, 0], [0.0, 1.0, 2.0, 0.0])
    np.testing.assert_allclose(played[:, 5:], [[0.5, -1.0]] * 4)
    assert len(policy.seen) == 2
    assert policy.resets == 1
    seen = policy.seen[0]
    assert seen.frames["primary"].image[0, 0].tolist() == [7, 7, 7]
    assert seen.frames["wrist"].image[0, 0].tolist() == [9, 9, 9]


def test_a_new_episode_begins_with_a_new_chunk():
    policy = Policy()
    start, look = ("episode_start", {}), ("observation", observed())
    talk([start, look, start, look], policy)
    assert (len(policy.seen), policy.resets) == (2, 2)


@pytest.mark.parametrize(
    ("kind", "payload", "words"),
    [
        ("observation", observed(task_description="refuse"), "Nothing to see."),
        ("observation", observed(images={"agentview": image(1)}), "expected 2"),
        ("observation", observed(states=[1.0]), "expected 8 finite numbers"),
        ("observation", observed(task_description=" "), "no task_description"),
        (
            "observation",
            observed(images={"a": {"__image__": True, "format": "png", "data": b"x"}, "b": 1}),
            "be read",
        ),
        ("nonsense", {}, "expected one of"),
    ],
)
def test_what_goes_wrong_is_told_and_the_client_stays(kind, payload, words):
    refused, served = talk([(kind, payload), ("observation", observed())], Policy())
    assert refused.kind == "error"
    assert words in refused.payload["error"]
    assert served.kind == "action"


def test_arrays_of_objects_are_not_taken():
    data = msgpack.packb(
        {
            "type": "observation",
            "seq": 1,
            "payload": {"x": {"__ndarray__": True, "data": b"", "dtype": "O", "shape": []}},
        }
    )
    with pytest.raises(InvalidInputError):
        wire.unpack(data)


@pytest.mark.parametrize("angle", [0.0, 1.0, np.pi, 4.0, 6.2])
def test_rotation_vectors_keep_their_branch(angle):
    """0 .. 2 pi: the quaternion's sign tells which of the two rotation vectors it was."""
    axis = np.array([0.8, 0.0, 0.6])
    quaternion = bridge._quaternion(axis * angle)
    assert 2.0 * np.arccos(np.clip(quaternion[3], -1, 1)) == pytest.approx(angle, abs=1e-7)
    turned = rotvec_from_matrix(matrix_from_quaternion(quaternion))
    shorter = min(angle, 2 * np.pi - angle)
    assert np.linalg.norm(turned) == pytest.approx(shorter, abs=1e-6)


@pytest.mark.slow
@pytest.mark.skipif(
    not VLA_EVAL.is_file(), reason="needs vla-eval in its own environment: make .venv-vla-eval"
)
@pytest.mark.parametrize("backend", ["openvla", "oft"])
def test_vla_evals_own_client_and_episode_runner_are_served(tmp_path, backend):
    checkpoint = tmp_path / "tiny"
    subprocess.run(
        [Path(sys.executable).parent / f"roboneuron-{backend}", "make-tiny", checkpoint], check=True
    )
    server = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "roboneuron.cli.main",
            "eval",
            "serve",
            "--backend",
            backend,
            "--checkpoint",
            checkpoint,
            "--port",
            "0",
            "--option",
            f"{backend}.unnorm_key=tiny",
            "--option",
            f"{backend}.max_outside_share=1",
            "--option",
            "torch.device=cpu",
            "--option",
            "torch.dtype=float32",
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout is not None
        url = re.search(r"ws://\S+", server.stdout.readline())
        assert url is not None
        script = ROOT / "plugins/rn-eval/interop/vla_eval_client.py"
        done = subprocess.run(
            [VLA_EVAL, script, url[0]], capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "served 20 steps" in done.stdout
    finally:
        server.terminate()
        server.wait(30)
        if server.stdout is not None:
            server.stdout.close()
