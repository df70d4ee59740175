"""Descriptors, options and the contract kit for both backends."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from rn_backend_pi0.case import ROW_TOLERANCE, fast_case
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.plugin import roboneuron_backends
from rn_testing import BackendCase, BackendContract
from rn_vla.tcp_profiles import PROFILES
from roboneuron.contract import Observation
from roboneuron.plugins.specs import BackendSpec

SPECS: dict[str, BackendSpec] = {spec.name: spec for spec in roboneuron_backends()}


class TestNative(BackendContract):
    """The native backend with a tiny checkpoint."""

    @pytest.fixture
    def plugin(self, tiny_checkpoint: Path, observe: Callable[..., Observation]) -> BackendCase:
        options = {"checkpoint": str(tiny_checkpoint), "device": "cpu", "cpu_threads": 1}
        return BackendCase(
            spec=SPECS["pi0"], options=options, observe=observe, row_tolerance=ROW_TOLERANCE
        )


@cache
def made_fast_case() -> BackendCase:
    """The case of pi0-FAST, whose checkpoint is made once for all rules."""
    return fast_case()


@pytest.mark.sampled(every=4)
class TestFast(BackendContract):
    """The backend of pi0-FAST with a tiny checkpoint."""

    @pytest.fixture
    def plugin(self) -> BackendCase:
        return made_fast_case()


def test_the_page_says_the_units_of_every_profile() -> None:
    page = Path(__file__).parents[3] / "docs" / "vla.md"
    lines = page.read_text(encoding="utf-8").splitlines()
    for name, profile in PROFILES.items():
        [row] = [line for line in lines if line.startswith(f"| `{name}` | `pi0` |")]
        action = profile.action
        scale = f"{action.translation_scale_m:g} m, {action.rotation_scale_rad:g} rad"
        words = {"rotvec": "rotation vector", "rpy": "roll, pitch, yaw"}
        signs = {"signed_close": "-1 open, 1 closed", "open_fraction": "1 open, 0 closed"}
        for part in (
            scale,
            words[action.rotation],
            signs[action.gripper],
            f"{action.step_s:g} s",
        ):
            assert part in row, (name, part)
        assert action.frame == "base"
        assert ("state added" in row) == action.adds_state


def test_listing_the_plugin_imports_nothing_heavy() -> None:
    code = (
        "import sys, rn_backend_pi0.plugin as p; p.roboneuron_backends();"
        "print([m for m in ('numpy', 'torch', 'pydantic') if m in "
        "sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert shown.stdout.strip() == "[]"


def test_descriptors_say_what_the_backends_need() -> None:
    for spec in SPECS.values():
        assert spec.needs_state
        assert (spec.cameras, spec.optional_cameras) == (("primary",), ("wrist", "right_wrist"))
        assert spec.family == ""
    assert {r.module for r in SPECS["pi0"].requires} == {"torch", "safetensors", "tokenizers"}
    assert SPECS["pi0"].needs_checkpoint


@pytest.mark.parametrize(
    "options",
    [
        {"profile": "mars"},
        {"profile": "own"},
        {"profile": "libero", "state": {"terms": ["position"]}},
        {"device": "tpu"},
        {"dtype": "float8"},
        {"action_steps": 0},
        {"denoising_steps": 0},
        {"noise": "fixed", "seed": "random"},
        {"seed": -1},
        {"base_position_m": (float("nan"), 0.0, 0.0)},
        {"surplus": 1},
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        Pi0Options(checkpoint=Path("x"), **options)
