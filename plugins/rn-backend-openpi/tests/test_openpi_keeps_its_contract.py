"""Descriptors, options and the contract kit."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from rn_backend_openpi.case import policy_case
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import BACKEND
from rn_backend_openpi.profiles import PRESETS
from rn_backend_openpi.server_options import PolicyServerOptions
from rn_testing import BackendCase, BackendContract
from roboneuron.contract import Observation
from roboneuron.feature import loading

DOCS = Path(__file__).parents[3] / "docs"
SERVING = (DOCS / "serving.md").read_text(encoding="utf-8")
TWO_MACHINES = (DOCS / "two-machines.md").read_text(encoding="utf-8")


@pytest.mark.sampled(every=4)
class TestForeignServer(BackendContract):
    """The backend with a stand-in for openpi's own server."""

    @pytest.fixture
    def plugin(self, policy_server: Any, observe: Callable[..., Observation]) -> BackendCase:
        options = {
            "url": policy_server.url,
            "profile": "libero",
            "image_keys": {"primary": "observation/image"},
        }
        return BackendCase(spec=BACKEND, options=options, observe=observe)


class TestOwnServer(BackendContract):
    """The backend with RoboNeuron's own server, in a process of its own."""

    @pytest.fixture
    def plugin(self) -> BackendCase:
        return policy_case()


def test_the_pages_name_every_profile_and_their_examples_are_valid() -> None:
    assert [name for name in PRESETS if f"| `{name}`" not in SERVING] == []
    pages = SERVING + TWO_MACHINES
    files = [
        tomllib.loads(block) for block in re.findall(r"```toml\n(.*?)```", pages, flags=re.DOTALL)
    ]
    tables = [table for file in files for table in policy_tables(file)]
    served = [
        PolicyServerOptions(**file) for file in files if "checkpoint" in str(file.get("models"))
    ]
    assert (len(tables), len(served)) == (5, 2)
    for options in map(PolicyOptions.model_validate, tables):
        if options.profile is not None:
            layout_of(options)


def policy_tables(file: dict[str, Any]) -> list[dict[str, Any]]:
    """The tables of the backends `openpi` and `shared` in a file."""
    plugins = file.get("plugins", {})
    return [plugins[name] for name in ("openpi", "shared") if name in plugins]


@pytest.mark.parametrize(
    ("imported", "heavy"),
    [
        ("plugin", {"numpy", "torch", "pydantic", "msgpack", "websockets"}),
        ("client", {"torch", "prometheus_client"}),
    ],
)
def test_an_import_brings_nothing_heavy(imported: str, heavy: set[str]) -> None:
    code = f"import sys, rn_backend_openpi.{imported}; print({heavy} & sys.modules.keys())"
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert shown.stdout.strip() == "set()"


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"url": "http://x"},
        {"url": "x"},
        {"url": "ws://x", "address": "gpu:1"},
        {"url": "ws://x", "model": "oft"},
        {"backend": "oft", "model": "a"},
        {"backend": "oft", "profile": "libero"},
        {"address": "gpu:1", "ca_file": "x"},
        {"url": "ws://x", "prompt_key": "task"},
        {"image_keys": {}},
        {"image_keys": {"primary": ""}},
        {"timeout_s": 0},
        {"profile": "mars"},
        {"profile": "libero-openpi"},
        {"profile": "own"},
        {"profile": "own", "action": {"kind": "torque", "rate_hz": 10, "gripper": "none"}},
        {"profile": "libero", "action": {"kind": "joint_delta", "rate_hz": 1, "gripper": "none"}},
        {"profile": "libero", "arms": ["left", "right"]},
        {"profile": "libero", "token_file": "k", "api_key_variable": "K"},
        {"profile": "libero", "image_size_px": [8, 8]},
        {"base_position_m": (float("nan"), 0.0, 0.0)},
        {"profile": "libero", "rate_hz": 20.0},
        {"profile": "droid", "space": "joint_velocity"},
        {"surplus": 1},
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any]) -> None:
    has_place = {"url", "address", "backend"} & options.keys() or not options
    with pytest.raises(ValidationError):
        PolicyOptions(**({} if has_place else {"url": "ws://x"}), **options)


def test_names_of_earlier_releases_are_read_and_told(caplog: pytest.LogCaptureFixture) -> None:
    old = {
        "profile": "libero",
        "api_key_file": "key",
        "ca": "ca.pem",
        "request_timeout_s": 2.0,
        "connect_timeout_s": 3.0,
    }
    read = loading.load_options(BACKEND, {"url": "ws://x", **old})
    assert isinstance(read, PolicyOptions)
    assert (str(read.token_file), str(read.ca_file)) == ("key", "ca.pem")
    assert (read.timeout_s, read.start_timeout_s) == (2.0, 3.0)
    assert all(name in caplog.text for name in old.keys() - {"profile"})
    caplog.clear()
    plain = {"profile": "roboneuron", "space": "joint_velocity", "joints": ["a"], "slides": []}
    read = loading.load_options(BACKEND, {"url": "ws://x", **plain})
    assert isinstance(read, PolicyOptions)
    assert (read.profile, read.space, read.joints) == (None, None, None)
    assert all(name in caplog.text for name in plain)
