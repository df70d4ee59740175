"""The case of an installed descriptor: shipped by its author, or built from the descriptor
alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rn_testing.cases import CASES, Case
from rn_testing.extension_cases import FeatureCase
from rn_testing.kinds import kind_of
from roboneuron import FeatureSpec, PluginError, Spec
from roboneuron.command import discover
from roboneuron.feature import loading


def installed_needs(
    spec: FeatureSpec, installed: Mapping[str, FeatureSpec]
) -> tuple[FeatureSpec, ...]:
    """The installed features that a feature needs, and those that these need."""
    found: dict[str, FeatureSpec] = {}
    waiting = [*spec.needs]
    while waiting:
        name = waiting.pop()
        if name in installed and name not in found:
            found[name] = installed[name]
            waiting += installed[name].needs
    return tuple(found.values())


def make_case(spec: Spec, options: Mapping[str, object]) -> Case[Spec]:
    """Return the case of `spec`, with `options` overriding its own.

    Raises:
        PluginError: the descriptor's `case` cannot be imported, raises, or returns no case of this
            descriptor.
    """
    brought = None if spec.kind in CASES else kind_of(type(spec))
    expected = CASES.get(spec.kind, Case) if brought is None else brought.case
    if isinstance(spec, FeatureSpec) and spec.case is None:
        needs = installed_needs(spec, discover().specs(FeatureSpec))
        return FeatureCase(spec=spec, options=options, is_automatic=True, needs=needs)
    if spec.case is None:
        return expected(spec=spec, options=options, is_automatic=True)
    function = loading.load_attribute(spec.case, f"`case` of {spec.name!r}")
    if not callable(function):
        raise PluginError(
            f"The `case` of {spec.name!r} ({spec.case}) is {function!r}, expected a function."
        )
    case = function()
    if not isinstance(case, expected) or case.spec != spec:
        raise PluginError(
            f"The `case` of {spec.name!r} ({spec.case}) returned {type(case).__name__}, "
            f"expected a {expected.__name__} of this descriptor."
        )
    return replace(case, options={**case.options, **options})
