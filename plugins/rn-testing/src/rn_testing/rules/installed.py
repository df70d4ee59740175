"""The plugins installed in the kit's environment."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator

from rn_testing.cases import PackageCase
from rn_testing.distribution import normalise
from roboneuron import DriverSpec, RobotSpec, Spec
from roboneuron.command import discover
from roboneuron.feature import Registry


def specs_of(case: PackageCase) -> Iterator[Spec | DriverSpec]:
    """Descriptors of a distribution or plugin that can be read, including those of drivers."""
    for offer in plugins().all_offers:
        if normalise(offer.distribution) == normalise(case.distribution) and case.plugin in (
            "",
            offer.plugin,
        ):
            yield offer.spec
            if isinstance(offer.spec, RobotSpec):
                yield from offer.spec.drivers


def plugins() -> Registry:
    """The installed plugins."""
    return _discovered(tuple(sys.path))


@functools.lru_cache(maxsize=4)
def _discovered(path: tuple[str, ...]) -> Registry:
    """The plugins on an import path; cached, because most rules use them."""
    return discover()
