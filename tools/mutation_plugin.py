"""Pytest plugin for tools/mutations.py, instead of the repository's conftest.py."""

from __future__ import annotations

from typing import Any

pytest_plugins = ("rn_testing.gate_fixtures",)
_MOST_EXAMPLES = 60
"""Maximum number of examples of a property per mutant."""


def pytest_collection() -> None:
    """Use the same examples of a property for every mutant, and stop at the first failure, because
    nobody reads it.
    """
    # imported late, after pytest's own plugins, which pytest rewrites
    from hypothesis import HealthCheck, Phase, settings

    settings.register_profile(
        "mutations",
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow],
        database=None,
        derandomize=True,
        phases=(Phase.explicit, Phase.generate),
    )
    settings.load_profile("mutations")


def pytest_itemcollected(item: Any) -> None:
    """Bound the number of examples of a property."""
    from hypothesis import settings

    name = "_hypothesis_internal_use_settings"
    test = getattr(item, "obj", None)
    asked = getattr(test, name, None)
    if asked is not None and asked.max_examples > _MOST_EXAMPLES:
        setattr(test, name, settings(asked, max_examples=_MOST_EXAMPLES))
