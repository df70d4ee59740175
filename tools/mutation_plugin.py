"""Plugin of the pytest that tools/mutations.py runs, in the place of the repository's
conftest.py.
"""

from __future__ import annotations

from typing import Any

pytest_plugins = ("rn_testing.gate_fixtures",)
_MOST_EXAMPLES = 60
"""Of a property, per mutant."""


def pytest_collection() -> None:
    """Try the same examples of a property for every mutant, and end at the first that fails: nobody
    reads it.
    """
    # later than pytest's own plugins, which pytest rewrites
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
    """Bound the examples of a property that asks for more."""
    from hypothesis import settings

    name = "_hypothesis_internal_use_settings"
    test = getattr(item, "obj", None)
    asked = getattr(test, name, None)
    if asked is not None and asked.max_examples > _MOST_EXAMPLES:
        setattr(test, name, settings(asked, max_examples=_MOST_EXAMPLES))
