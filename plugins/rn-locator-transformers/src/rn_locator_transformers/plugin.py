"""Descriptor of this package: the locator `transformers`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import LocatorSpec, Requirement, hookimpl

_MODULES = {"transformers": "transformers", "scipy": "scipy", "PIL": "pillow"}


@hookimpl
def roboneuron_locators() -> Sequence[LocatorSpec]:
    """Register the locator; it needs no depth, and uses it where there is one."""
    return (
        LocatorSpec(
            name="transformers",
            summary="Whatever labels name, boxed by OWLv2 or Grounding DINO from a local folder.",
            target="rn_locator_transformers.locator:TransformersLocator",
            config="rn_locator_transformers.options:TransformersLocatorOptions",
            case="rn_locator_transformers.case:case",
            requires=(
                Requirement(module="torch", install="pip install torch (which build: README.md)"),
                *(
                    Requirement(module=module, install=f"pip install {name}")
                    for module, name in _MODULES.items()
                ),
            ),
            limit_s=30.0,
            takes_labels=True,
            own_process=True,
        ),
    )
