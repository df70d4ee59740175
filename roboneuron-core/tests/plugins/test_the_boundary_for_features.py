"""`roboneuron.feature` offers what it lists, lazily, and nothing that `roboneuron` has under
another meaning.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

import roboneuron
import roboneuron.feature


def test_every_name_is_there_and_none_is_in_both() -> None:
    for name in roboneuron.feature.__all__:
        assert getattr(roboneuron.feature, name) is not None
    assert set(roboneuron.feature.__all__) & set(roboneuron.__all__) == set()


def test_a_name_that_is_not_listed_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Bringup'"):
        _ = roboneuron.feature.Bringup  # type: ignore[attr-defined]


def test_importing_it_imports_nothing_heavy() -> None:
    script = (
        "import sys, roboneuron.feature; print([m for m in ('numpy', 'pydantic', 'rclpy', "
        "'mcp') if m in sys.modules])"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True
        ).stdout.strip()
        == "[]"
    )
