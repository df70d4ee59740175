"""Names that features used once: an error that says what replaces them."""

from __future__ import annotations

from roboneuron.errors import PluginError


class Moved:
    """Attribute that is no more; reading or setting it raises PluginError.

    Args:
        instead: what replaces it.
    """

    def __init__(self, instead: str) -> None:
        self._instead = instead
        self._name = ""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = f"{owner.__name__}.{name}"

    def __get__(self, instance: object, owner: type) -> object:
        if instance is None:
            return self
        raise PluginError(
            f"{self._name} is no more; {self._instead} replaces it.",
            hint="docs/interceptors.md shows how.",
        )

    def __set__(self, instance: object, value: object) -> None:
        self.__get__(instance, type(instance))
