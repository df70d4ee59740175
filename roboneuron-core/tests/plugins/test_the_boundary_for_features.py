"""`roboneuron.feature` and `.command` lazily offer what they list, and no name with
another meaning than in `roboneuron`.
"""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

import roboneuron

LISTS = ("roboneuron.feature", "roboneuron.command")


@pytest.mark.parametrize("of", LISTS)
def test_every_name_is_there_and_none_is_public_too(of: str) -> None:
    listed = import_module(of)
    for name in listed.__all__:
        assert getattr(listed, name) is not None
    assert set(listed.__all__) & set(roboneuron.__all__) == set()


@pytest.mark.parametrize("of", LISTS)
def test_a_name_that_is_not_listed_is_no_attribute(of: str) -> None:
    with pytest.raises(AttributeError, match=f"{of!r} has no attribute 'Bringup'"):
        _ = import_module(of).Bringup


@pytest.mark.parametrize("of", LISTS)
def test_importing_it_imports_nothing_heavy(of: str) -> None:
    script = (
        f"import sys, {of}; print([m for m in ('numpy', 'pydantic', 'rclpy', 'mcp') "
        "if m in sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True
        ).stdout.strip()
        == "[]"
    )
