"""The locator's contract case: a tiny random checkpoint, which tells the painted cubes from the
bare table, but neither what nor where they are.
"""

from __future__ import annotations

import atexit
import functools
import tempfile
from pathlib import Path

from rn_locator_transformers.plugin import roboneuron_locators
from rn_locator_transformers.tiny import make_tiny
from rn_testing import LocatorCase
from rn_testing.fakes.painted_table import painted_cubes

_SEED, _LEAST_SCORE = 6, 0.94
"""Of the empty table these weights make at most 0.91, of the cubes 1.0."""


def case() -> LocatorCase:
    """OWLv2."""
    (spec,) = roboneuron_locators()
    return LocatorCase(
        spec=spec,
        options={
            "checkpoint": str(_checkpoint()),
            "labels": ["a red cube"],
            "least_score": _LEAST_SCORE,
        },
        images=painted_cubes(),
    )


@functools.cache
def _checkpoint() -> Path:
    held = tempfile.TemporaryDirectory(prefix="rn-locator-transformers-")
    atexit.register(held.cleanup)
    folder = Path(held.name) / "tiny"
    make_tiny(folder, "owlv2", seed=_SEED)
    return folder
