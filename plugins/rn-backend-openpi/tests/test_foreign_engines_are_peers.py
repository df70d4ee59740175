"""Policy servers of others: each peer in the columns of the table in docs/serving.md, which is
computed from what happens here.

All are the stand-ins of `foreign_engines`; openpi's own code is tried by
test_openpi_public_code_is_on_the_other_end.py.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_engines import CAMERAS, EngineStandIn, OpenpiStandIn, SglangStandIn, VllmOmniStandIn
from numpy.typing import NDArray
from openpi_clients import SLACK_S, check_it_recovers, loaded

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import BACKEND
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    CheckpointError,
    ConfigurationError,
    JointSample,
    NotReadyError,
    Observation,
    UnsafeError,
)

F64 = NDArray[np.float64]
ROOT = Path(__file__).parents[3]
JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
TIMEOUT_S = 1.0
LOW, HIGH = -3.0 + 0.1 * np.arange(8), 2.0 + 0.1 * np.arange(8)
MEAN, STD = 0.1 * np.arange(8), 0.5 + 0.1 * np.arange(8)
KINDS = {"openpi": "none", "sglang": "quantiles", "vllm-omni": "mean_std"}
STAND_INS = {"openpi": OpenpiStandIn, "sglang": SglangStandIn, "vllm-omni": VllmOmniStandIn}


def scaled(kind: str, values: F64) -> F64:
    """Normalised values, by the definition of openpi's transforms."""
    if kind == "none":
        return values
    if kind == "quantiles":
        return (values - LOW) / (HIGH - LOW + 1e-6) * 2.0 - 1.0
    return (values - MEAN) / (STD + 1e-6)


def unscaled(kind: str, values: F64) -> F64:
    """The reverse of `scaled`."""
    if kind == "none":
        return values
    if kind == "quantiles":
        return (values + 1.0) / 2.0 * (HIGH - LOW + 1e-6) + LOW
    return values * (STD + 1e-6) + MEAN


@pytest.fixture
def statistics(tmp_path: Path) -> Path:
    """A norm_stats.json of eight values."""
    part = {"mean": MEAN.tolist(), "std": STD.tolist(), "q01": LOW.tolist(), "q99": HIGH.tolist()}
    path = tmp_path / "norm_stats.json"
    path.write_text(json.dumps({"norm_stats": {"state": part, "actions": part}}))
    return path


class Follower:
    """The served network: it answers with the state that it got, in its own units, 0.01 further in
    each row, and the mean brightness of its first camera in the gripper's place.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.fails = False

    def __call__(self, images: dict[str, Any], state: NDArray[np.float32], prompt: str) -> F64:
        if self.fails:
            raise ValueError("the network failed on purpose")
        assert prompt
        reached = unscaled(self.kind, state.astype(np.float64))
        rows = np.tile(reached, (10, 1)) + 0.01 * np.arange(10)[:, None]
        rows[:, 7] = images[CAMERAS[0]].mean() / 255.0
        return scaled(self.kind, rows)


def seen() -> Observation:
    """An observation with the joints of the profile."""
    made = make_observation(BACKEND)
    frame = made.frames["primary"]
    image = np.full((224, 224, 3), 51, dtype=np.uint8)
    return replace(
        made,
        frames={role: replace(frame, image=image) for role in ("primary", "wrist", "right_wrist")},
        joints=JointSample(names=JOINTS, position=np.linspace(-0.6, 0.6, 7)),
        gripper_open=0.25,
        instruction="pick up the cube",
    )


Make = Callable[..., tuple[EngineStandIn, Follower, PolicyOptions]]
PEERS = {
    "openpi": ("openpi", "/"),
    "SGLang /openpi/policy": ("sglang", "/openpi/policy"),
    "SGLang /v1/actions/realtime": ("sglang", "/v1/actions/realtime"),
    "vLLM-Omni /v1/realtime/robot/openpi": ("vllm-omni", "/v1/realtime/robot/openpi"),
}


@pytest.fixture
def peer(statistics: Path) -> Iterator[Make]:
    """Return a function that starts a stand-in and makes the options for it."""
    made: list[EngineStandIn] = []

    def start(name: str, **changes: Any) -> tuple[EngineStandIn, Follower, PolicyOptions]:
        engine, path = PEERS[name]
        policy = Follower(KINDS[engine])
        server = STAND_INS[engine](policy)
        server.path = path
        server.start()
        made.append(server)
        has_path = path == "/v1/actions/realtime"
        given: dict[str, Any] = {
            "url": server.url + path * has_path,
            "profile": "franka",
            "joints": JOINTS,
            "start_timeout_s": 5.0,
            "warm_up_timeout_s": 5.0,
            "timeout_s": TIMEOUT_S,
        }
        if engine != "openpi":
            table = {"file": statistics, "kind": KINDS[engine]}
            given |= {"engine": engine, "normalisation": table}
        return server, policy, PolicyOptions(**(given | changes))

    yield start
    for server in made:
        server.stop()


@pytest.mark.parametrize("name", PEERS)
def test_states_and_rows_are_converted_and_named_as_the_engine_has_them(
    peer: Make, name: str
) -> None:
    server, _, options = peer(name)
    with loaded(options) as backend:
        chunk = backend.predict(seen())
    assert chunk.space.kind == "joint_position"
    expected = np.linspace(-0.6, 0.6, 7) + 0.01 * np.arange(10)[:, None]
    np.testing.assert_allclose(chunk.actions[:, :7], expected, atol=1e-5)  # float32 on the wire
    np.testing.assert_allclose(chunk.actions[:, 7], 1.0 - 51 / 255.0, atol=1e-5)
    request = server.requests[-1]
    if name == "openpi":
        assert request.keys() > {"observation/image", "observation/state", "prompt"}
        return
    images = {
        key for key, value in request.items() if isinstance(value, np.ndarray) and value.ndim == 3
    }
    assert images == {"observation.images.base_0_rgb", "observation.images.left_wrist_0_rgb"}
    state = request["observation.state" if "SGLang" in name else "state"]
    assert (state.dtype, state.shape) == (np.float32, (8,))


def tried(peer: Make, name: str) -> tuple[str, ...]:
    """The cells of a row of the table: what was seen in each column."""
    server, policy, options = peer(name)
    with loaded(options) as backend:
        first = backend.predict(seen())
        assert any(np.ndim(value) == 3 for value in server.requests[-1].values()), "raw images"
        assert "roboneuron" not in server.requests[-1], "no real-time chunking"
        policy.fails = True
        with pytest.raises(NotReadyError) as told:
            backend.predict(seen())
        policy.fails = False
        check_it_recovers(backend, seen())
        server.held.clear()
        begun_s = time.monotonic()
        with pytest.raises(NotReadyError, match="gave no answer within"):
            backend.predict(replace(seen(), gripper_open=0.75))
        assert time.monotonic() - begun_s < TIMEOUT_S + SLACK_S
        server.held.set()
        check_it_recovers(backend, seen())
        again = backend.predict(seen()).actions
        np.testing.assert_array_equal(again, first.actions, "the late answer was dropped")
        server.stop()
        begun_s = time.monotonic()
        with pytest.raises(NotReadyError):
            backend.predict(seen())
        assert time.monotonic() - begun_s < TIMEOUT_S + SLACK_S
        server.start()
        check_it_recovers(backend, seen())
    return (
        _space(peer, name),
        "cause shown" if "failed on purpose" in str(told.value) else "shown without a cause",
    )


def _space(peer: Make, name: str) -> str:
    """Which differences of the interface the metadata uncover."""
    found = []
    for what, changes in (
        ("cameras", {"image_keys": {"primary": "observation.images.front"}}),
        ("width", {"profile": "aloha", "joints": tuple(f"joint{i}" for i in range(12))}),
        ("kind", {"profile": "droid"}),
    ):
        try:
            with loaded(peer(name, **changes)[2]):
                pass
        except ConfigurationError:
            found.append(what)
        except (NotReadyError, UnsafeError):
            pass
    return f"{', '.join(found)} checked" if found else "the profile's"


def test_the_table_of_peers_is_what_happens(peer: Make) -> None:
    lines = [
        "| peer | space | errors |",
        "|---|---|---|",
    ]
    for name in PEERS:
        lines.append(f"| {' | '.join((name, *tried(peer, name)))} |")
    page = (ROOT / "docs" / "serving.md").read_text(encoding="utf-8")
    missing = [line for line in lines if line not in page]
    assert not missing, "write this table into docs/serving.md:\n" + "\n".join(lines)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"normalisation": None}, "an engine needs normalisation"),
        ({"profile": "roboneuron", "joints": None}, "none of RoboNeuron's rows"),
        ({"engine": None}, "normalisation belongs to an engine"),
    ],
)
def test_options_that_do_not_fit_an_engine_are_refused(
    peer: Make, changes: dict[str, Any], word: str
) -> None:
    with pytest.raises(ValueError, match=word):
        peer("SGLang /openpi/policy", **changes)


def test_a_bare_network_moves_no_robot(peer: Make, statistics: Path) -> None:
    """Without statistics a row in -1..1 would be taken for radians."""
    name = "SGLang /openpi/policy"
    plain = {"engine": None, "normalisation": None, "url": peer(name)[0].url + "/openpi/policy"}
    with pytest.raises(ConfigurationError, match="serves 'pi05' bare"):
        PolicyBackend(peer(name, **plain)[2]).load()
    with pytest.raises(ConfigurationError, match="serves 'pi05' bare"):
        PolicyBackend(peer(name, normalisation="server")[2]).load()
    statistics.write_text("{}")
    with pytest.raises(CheckpointError, match="norm_stats"):
        PolicyBackend(peer(name)[2]).load()
