"""The case of an installed descriptor: the one its author ships, or one made from the descriptor alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rn_testing.cases import CASES, Case
from rn_testing.extension_cases import FeatureCase
from roboneuron.errors import PluginError
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import FeatureSpec, Spec


def make_case(spec: Spec, options: Mapping[str, object]) -> Case[Any]:
    """Return the case of `spec`, with `options` over its own.

    Raises:
        PluginError: the descriptor's `case` cannot be imported, raises, or returns no case of this descriptor.
    """
    expected = CASES.get(spec.kind, Case)  # of a kind that another plugin has brought
    if isinstance(spec, FeatureSpec) and spec.case is None:
        installed = discover().specs(FeatureSpec)
        needs = tuple(installed[name] for name in spec.needs if name in installed)
        return FeatureCase(spec=spec, options=options, is_automatic=True, needs=needs)
    if spec.case is None:
        return expected(spec=spec, options=options, is_automatic=True)
    function = load_attribute(spec.case, f"`case` of {spec.name!r}")
    if not callable(function):
        raise PluginError(f"The `case` of {spec.name!r} ({spec.case}) is {function!r}, expected a function.")
    case = function()
    if not isinstance(case, expected) or case.spec != spec:
        raise PluginError(
            f"The `case` of {spec.name!r} ({spec.case}) returned {type(case).__name__}, "
            f"expected a {expected.__name__} of this very descriptor."
        )
    return replace(case, options={**case.options, **options})
