"""The plugins that are installed where the kit runs."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterator

from rn_testing.cases import PackageCase
from rn_testing.distribution import normalise
from roboneuron import DriverSpec, RobotSpec, Spec
from roboneuron.command import Registry, discover


def specs_of(case: PackageCase) -> Iterator[Spec | DriverSpec]:
    """The descriptors of a distribution or plugin that can be read here, those of drivers
    included.
    """
    for offer in plugins().all_offers:
        if normalise(offer.distribution) == normalise(case.distribution) and case.plugin in (
            "",
            offer.plugin,
        ):
            yield offer.spec
            if isinstance(offer.spec, RobotSpec):
                yield from offer.spec.drivers


def plugins() -> Registry:
    """The plugins that are installed here."""
    return _discovered(tuple(sys.path))


@functools.lru_cache(maxsize=4)
def _discovered(path: tuple[str, ...]) -> Registry:
    """The plugins on an import path, for which most rules ask."""
    return discover()
