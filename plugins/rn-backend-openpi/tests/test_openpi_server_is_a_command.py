"""The command `roboneuron policy openpi`: what it serves, and refusals by name."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from argparse import Namespace
from pathlib import Path
from typing import Any

import pytest
from openpi_clients import http_get, loaded

from rn_backend_openpi.case import REFLEX
from rn_backend_openpi.interface import served_layout
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.serve_command import served_options
from rn_testing.fakes.site import PluginSite
from roboneuron import EE_DELTA
from roboneuron.config import parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.discovery import discover

SOURCE = """
import numpy as np
from roboneuron import ActionChunk, BackendSpec, hookimpl

class Still:
    def __init__(self, config, *, runtime=None, acceleration=None):
        pass
    def load(self):
        print("loaded", flush=True)
    def predict(self, observation):
        rows = np.zeros((2, 7))
        rows[:, 6] = observation.gripper_open
        return ActionChunk(actions=rows, step_s=0.05)
    def reset(self):
        pass
    def close(self):
        print("closed", flush=True)

@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="still", target=__name__ + ":Still", summary="Does not move.",
                        needs_state=True)]
"""
CONFIG = """
[robot]
name = "fr3"
{inference}
[plugins.openpi]
{openpi}
[plugins.openpi.server]
{server}
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of plugins with two small backends."""
    folder = tmp_path / "site"
    PluginSite(path=folder).install("rn-still", SOURCE, header="")
    monkeypatch.syspath_prepend(str(folder))
    return folder


def _text(backend: str, openpi: str = "", server: str = "") -> str:
    inference = f'[inference]\nbackend = "{backend}"' if backend else ""
    return CONFIG.format(inference=inference, openpi=openpi, server=server)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (_text(""), "names no backend"),
        (_text("openpi"), "is itself a client of a server"),
        (_text("mars"), "There is no backend 'mars'"),
        (_text("still", server="clients = 0"), "robots"),
        (_text("still", server="surplus = 1"), "surplus"),
    ],
)
def test_what_cannot_be_served_is_refused_by_name(site: Path, text: str, word: str) -> None:
    registry = discover()
    config = parse_config(text, registry=registry)
    with pytest.raises(ConfigurationError, match=word):
        served_options(config, registry, Namespace(host=None, port=None))


@pytest.mark.parametrize(
    ("interface", "word"),
    [
        (
            {"profile": "ur5e", "joints": ["a", "b", "c", "d", "e", "f"]},
            "answers in 'ee_delta_base', profile 'ur5e' is for 'joint_position@20:a,b",
        ),
        (
            {"profile": "libero", "image_keys": {"wrist": "w"}},
            "needs the camera 'primary'; profile 'libero' has keys for wrist",
        ),
    ],
)
def test_an_interface_that_does_not_fit_the_backend_is_refused(
    interface: dict[str, Any], word: str
) -> None:
    options = InterfaceOptions.model_validate(interface)
    with pytest.raises(ConfigurationError, match=word):
        served_layout(options, REFLEX, EE_DELTA)


def test_the_command_serves_until_it_is_told_to_end(site: Path, tmp_path: Path) -> None:
    config = tmp_path / "gpu.toml"
    config.write_text(_text("still", server="stateless = true\nport = 0"))
    run = Path(tempfile.mkdtemp(prefix="rn-"))  # a socket's path must be short
    (tmp_path / "run").symlink_to(run)
    own = {"PYTHONPATH": str(site), "HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(run)}
    process = subprocess.Popen(
        [sys.executable, "-m", "roboneuron.cli.main", "policy", "openpi", "--config", str(config)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={"PATH": "/usr/bin:/bin", **own},
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline().strip()
        assert line.endswith("(backend still)")
        url = line.split()[2]
        assert http_get(url, "/healthz") == (200, b"OK\n")
        with loaded(PolicyOptions(url=url)):
            pass
        process.terminate()
        _, err = process.communicate(timeout=30.0)
        assert process.returncode == 0, err
        (log,) = tmp_path.glob("run/roboneuron/*-still.log")
        said = log.read_text().split()
        assert {"loaded", "closed"} <= set(said)
    finally:
        process.kill()
