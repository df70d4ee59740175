"""Kinds of descriptors that other plugins bring (monitors, suites of tasks), with their case and
rules.

Such a descriptor class names them: `rules: ClassVar[str] = "my_package.contract_cases:KIND"`. That
module is loaded by the kit only, and may import it.
"""

from __future__ import annotations

from dataclasses import dataclass

from rn_testing.case import Case
from rn_testing.rule import AnyRule
from roboneuron import PluginError, Spec
from roboneuron.command import loading
from roboneuron.feature import discover


@dataclass(frozen=True, kw_only=True, slots=True)
class Kind:
    """What the kit needs to try descriptors of one kind.

    Attributes:
        case: class of their cases.
        rules: all that apply, those of every descriptor included.
    """

    case: type[Case[Spec]]
    rules: tuple[AnyRule, ...]


def named_by(spec: type[Spec]) -> str:
    """Where a descriptor class says that its rules are, as "module:attribute"; empty when it says
    nothing.
    """
    return str(getattr(spec, "rules", ""))


def kind_of(spec: type[Spec]) -> Kind | None:
    """Case and rules of a descriptor class that another plugin has brought; None when it names
    none.

    Raises:
        PluginError: what it names cannot be imported or is no Kind.
    """
    place = named_by(spec)
    if not place:
        return None
    found = loading.load_attribute(place, f"`rules` of {spec.__name__}")
    if not isinstance(found, Kind):
        raise PluginError(
            f"The `rules` of {spec.__name__} ({place}) is {type(found).__name__}, expected a Kind."
        )
    return found


def brought_kind(name: str) -> Kind | None:
    """As `kind_of`, for the name of an installed kind."""
    spec = discover().kinds.get(name)
    return None if spec is None else kind_of(spec)
