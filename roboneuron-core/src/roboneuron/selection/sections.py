"""Section of a module with another plugin than the configured one."""

from __future__ import annotations

from typing import TypeVar

from roboneuron.config.models import Section

S = TypeVar("S", bound=Section)

_OF_THE_PLUGIN = {
    "driver",
    "arm",
    "namespace",
    "python",
    "start_timeout_s",
    "cameras",
    "checkpoint",
    "runtime",
    "acceleration",
    "instruction",
}
"""Keys that are meant for the configured plugin only. An instruction also is: a client that names
another policy says itself what that one shall do.
"""


def section_for(model: type[S], configured: Section | None, field: str, name: str) -> S:
    """Return a section of `model` with the plugin `name` in `field`.

    The other keys stay as configured, so that naming a plugin loosens no timeout or bound; those
    that are meant for the configured plugin only have their defaults.
    """
    kept: dict[str, object] = {}
    if configured is not None:
        kept = {key: getattr(configured, key) for key in configured.model_fields_set}
    kept = {key: value for key, value in kept.items() if key not in _OF_THE_PLUGIN}
    return model.model_validate({**kept, field: name})
