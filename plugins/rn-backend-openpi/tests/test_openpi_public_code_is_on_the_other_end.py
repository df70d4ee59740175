"""The published openpi-client uses RoboNeuron's server, and openpi's own server answers
RoboNeuron's client; likewise RoboArena's client and server. All in the environment of `make
test-openpi-peers`.
"""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import REFLEX, Reflex, ReflexOptions, serving
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.options import PolicyOptions
from rn_vla.letterbox import fit_antialiased
from roboneuron import (
    EE_DELTA,
    Channel,
    ControlSpace,
    JointSample,
    NotReadyError,
    Observation,
)

Observe = Callable[..., Observation]
ROOT = Path(__file__).parents[3]
INTEROP = Path(__file__).parents[1] / "interop"
PYTHON = Path(
    os.environ.get("ROBONEURON_OPENPI_CLIENT_PYTHON", ROOT / ".venv-openpi-client/bin/python")
)
OPENPI = Path(os.environ.get("ROBONEURON_OPENPI", ROOT.parent / "openpi"))
SERVER = OPENPI / "src" / "openpi" / "serving" / "websocket_policy_server.py"
needs_client = pytest.mark.skipif(
    not PYTHON.exists(), reason="openpi-client is not there; make .venv-openpi-client"
)
needs_server = pytest.mark.skipif(
    not SERVER.exists(), reason=f"{OPENPI} is no checkout of openpi; make test-openpi-peers OPENPI="
)
ROBOARENA = Path(os.environ.get("ROBONEURON_ROBOARENA", ROOT.parent / "roboarena"))
needs_arena = pytest.mark.skipif(
    not (ROBOARENA / "roboarena" / "policy_server.py").exists(),
    reason=f"{ROBOARENA} is no checkout of roboarena; make test-openpi-peers ROBOARENA=",
)
ARM = tuple(f"joint{i}" for i in range(1, 8))
KEY = "a-key-of-some-length"
DROID = ControlSpace(
    kind="joint_velocity",
    channels=(
        *(Channel(name=name, unit="rad/s") for name in ARM),
        Channel(name="gripper_open", unit="opening"),
    ),
    rate_hz=15.0,
)
CASES: dict[str, tuple[ControlSpace, dict[str, Any], float]] = {
    "libero": (EE_DELTA, {"profile": "libero"}, 0.05),
    "droid": (DROID, {"profile": "droid", "joints": ARM}, 1 / 15),
}


def _request(profile: str, number: int) -> dict[str, Any]:
    """Request of openpi's examples, with images of a camera's size."""
    rng = np.random.default_rng(number)
    images = rng.integers(0, 256, (2, 120, 160, 3), dtype=np.uint8)
    if profile == "libero":
        state = np.array([0.4, 0.1, 0.5, np.pi, 0.01, 0.02, 0.03, -0.03]) + 0.001 * number
        return {
            "observation/image": images[0],
            "observation/wrist_image": images[1],
            "observation/state": state,
            "prompt": "pick up the red cube",
        }
    return {
        "observation/exterior_image_1_left": images[0],
        "observation/wrist_image_left": images[1],
        "observation/joint_position": rng.standard_normal(7),
        "observation/gripper_position": np.array([0.25]),
        "prompt": "pick up the red cube",
    }


@needs_client
@pytest.mark.parametrize("profile", CASES)
def test_the_published_client_gets_our_backends_rows(profile: str, tmp_path: Path) -> None:
    space, given, step_s = CASES[profile]
    model = Reflex(ReflexOptions(step_s=step_s), space=space)
    spec = replace(REFLEX, optional_cameras=("wrist",))
    requests = {str(number): _request(profile, number) for number in range(3)}
    token = tmp_path / "token"
    token.write_text(KEY)
    token.chmod(0o600)
    asked, told = tmp_path / "requests.npz", tmp_path / "answers.npz"
    arrays = {f"{n}|{key}": value for n in requests for key, value in requests[n].items()}
    np.savez(asked, **arrays)
    with serving(model, spec, interface=given, space=space, keys="token", token_file=token) as url:
        done = subprocess.run(
            [PYTHON, INTEROP / "openpi_client_asks.py", url, asked, told, KEY],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    layout = layout_of(InterfaceOptions.model_validate(given))
    with np.load(told) as answers:
        for number, entries in requests.items():
            sent = {key: _fitted(value) for key, value in entries.items()}
            seen = layout.observation_of(sent, needed=("primary",), has_state=True)
            local = layout.rows.from_contract(model.predict(seen).actions, seen)
            assert answers[f"{number}|actions"].tobytes() == local.tobytes()
            assert answers[f"{number}|infer_ms"] > 0.0
        assert f"'profile': '{profile}'" in str(answers["metadata"])
        assert "InvalidInputError" in str(answers["refused"])


def _fitted(value: Any) -> Any:
    is_image = isinstance(value, np.ndarray) and value.ndim == 3
    return fit_antialiased(value, (224, 224)) if is_image else value


@pytest.fixture
def foreign_server() -> Iterator[Callable[..., str]]:
    """Start a program of `interop` with these arguments, "PORT" replaced; returns its URL."""
    processes: list[subprocess.Popen[bytes]] = []

    def start(program: str, *arguments: object) -> str:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = str(probe.getsockname()[1])
        words = [port if word == "PORT" else str(word) for word in arguments]
        processes.append(subprocess.Popen([PYTHON, INTEROP / program, *words]))
        return f"ws://127.0.0.1:{port}"

    yield start
    for process in processes:
        process.kill()
        process.wait()


@needs_client
@needs_server
@pytest.mark.parametrize("profile", CASES)
def test_our_client_gets_the_rows_of_openpis_server(
    profile: str, foreign_server: Callable[..., str], observe: Observe
) -> None:
    space, given, step_s = CASES[profile]
    width = len(space.channels)
    url = foreign_server("openpi_server_serves.py", OPENPI, "PORT", width)
    options = PolicyOptions(url=url, start_timeout_s=30.0, timeout_s=20.0, **given)
    backend = PolicyBackend(options)
    backend.load()
    joints = JointSample(names=ARM, position=np.linspace(-1, 1, 7))
    seen = replace(observe(wrist=40), joints=joints)
    chunk = backend.predict(seen)
    layout = layout_of(options)
    request = layout.request_of(seen)
    rows = np.tile(np.arange(10.0)[:, None], (1, len(space.channels)))
    arrays = [request[key] for key in sorted(request) if isinstance(request[key], np.ndarray)]
    for column, array in enumerate(arrays):
        assert isinstance(array, np.ndarray)
        rows[:, column] += array.astype(np.float64).sum()
    served = (rows / 1e9).astype(np.float32).astype(np.float64)
    assert chunk.actions.tobytes() == layout.rows.to_contract(served, seen).tobytes()
    assert chunk.step_s == pytest.approx(step_s)
    assert chunk.metrics["server_ms"] == 1.5
    with pytest.raises(NotReadyError, match="ValueError: the policy failed on purpose"):
        backend.predict(replace(seen, instruction="fail"))
    assert backend.predict(seen).metrics["connections"] == 2
    backend.close()


ARENA = {"profile": "roboarena", "joints": ARM}


@needs_client
@needs_arena
def test_roboarenas_client_gets_an_answer() -> None:
    channels = [Channel(name=name, unit="rad") for name in ARM]
    channels.append(Channel(name="gripper_open", unit="opening"))
    space = ControlSpace(kind="joint_position", channels=tuple(channels), rate_hz=15.0)
    interface = {"dialect": "roboarena", **ARENA}
    spec = replace(REFLEX, optional_cameras=("wrist", "secondary"))
    with serving(
        Reflex(ReflexOptions(step_s=1 / 15), space=space), spec, interface=interface, space=space
    ) as url:
        done = subprocess.run(
            [PYTHON, INTEROP / "roboarena_peer.py", ROBOARENA, "ask", url.rsplit(":", 1)[1]],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("joint_position (4, 8) ")
    assert "reset successful" in done.stdout


@needs_client
@needs_arena
def test_our_client_gets_the_rows_of_roboarenas_server(
    foreign_server: Callable[..., str], observe: Observe
) -> None:
    url = foreign_server("roboarena_peer.py", ROBOARENA, "serve", "PORT")
    options = PolicyOptions(url=url, start_timeout_s=30.0, timeout_s=20.0, **ARENA)
    backend = PolicyBackend(options)
    backend.load()
    seen = replace(observe(), joints=JointSample(names=ARM, position=np.zeros(7)))
    assert [backend.predict(seen).actions[0, 6] for _ in range(2)] == [2.0, 3.0]
    backend.reset()
    chunk = backend.predict(seen)
    np.testing.assert_array_equal(chunk.actions, [[0.25] * 6 + [1.0, 0.75]] * 5)
    assert chunk.metrics["connections"] == 1
    backend.close()
