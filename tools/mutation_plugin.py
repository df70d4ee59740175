"""Plugin of the pytest that tools/mutations.py runs, in the place of the repository's
conftest.py.
"""

from __future__ import annotations


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
