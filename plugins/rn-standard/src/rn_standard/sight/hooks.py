"""Hook of locators, and their descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from roboneuron import Spec, hookspec


@dataclass(frozen=True, kw_only=True, slots=True)
class LocatorSpec(Spec):
    """A finder of objects in calibrated pictures.

    Attributes:
        needs_depth: it works on pictures with depth only.
        limit_s: longest time of one answer for two pictures of 640 x 480 [s].
    """

    kind: ClassVar[str] = "locator"
    rules: ClassVar[str] = "rn_standard.sight.contract_cases:KIND"

    needs_depth: bool = False
    limit_s: float = 1.0


@hookspec
def roboneuron_locators() -> Sequence[LocatorSpec]:  # type: ignore[empty-body]
    """Offer finders of objects: calibrated pictures to places in the base frame.

    `target` follows the protocol `rn_standard.sight.locator.Locator`; it is built as
    `target(config)` in the server. `[sight] locator` of the configuration names the one in use.
    """
