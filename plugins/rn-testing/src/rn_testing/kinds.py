"""Kinds of descriptors provided by other plugins (monitors, suites of tasks), with their cases and
rules.

Such a descriptor class names them: `rules: ClassVar[str] = "my_package.contract_cases:KIND"`. That
module is loaded by the kit only, and may import it.
"""

from __future__ import annotations

from dataclasses import dataclass

from rn_testing.case import Case
from rn_testing.rule import AnyRule
from roboneuron import PluginError, Spec
from roboneuron.command import discover
from roboneuron.feature import loading


@dataclass(frozen=True, kw_only=True, slots=True)
class Kind:
    """Definition of a kind of descriptors for the kit.

    Attributes:
        case: class of the cases.
        rules: all applicable rules, including those of every descriptor.
    """

    case: type[Case[Spec]]
    rules: tuple[AnyRule, ...]


def named_by(spec: type[Spec]) -> str:
    """Location of a descriptor class's rules as "module:attribute"; empty if it names none."""
    return str(getattr(spec, "rules", ""))


def kind_of(spec: type[Spec]) -> Kind | None:
    """Case and rules of a descriptor class from another plugin; None if it names none.

    Raises:
        PluginError: the named object cannot be imported or is no Kind.
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
    """Like `kind_of`, for the name of an installed kind."""
    spec = discover().kinds.get(name)
    return None if spec is None else kind_of(spec)
