"""Common base of both backends: no weights, and an episode that ends with another instruction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from roboneuron import StateError


class EpisodeBackend(ABC):
    """A backend between `load` and `close`, with one episode for each instruction.

    Attributes:
        name: name in the descriptor.
    """

    name: ClassVar[str]

    def __init__(self) -> None:
        self._is_loaded = False
        self._instruction = ""

    @abstractmethod
    def forget(self) -> None:
        """Clear everything seen and done."""

    def load(self) -> None:
        """Become ready; there are no weights to load."""
        self._is_loaded = True
        self.reset()

    def reset(self) -> None:
        """Reset the episode."""
        self.forget()
        self._instruction = ""

    def close(self) -> None:
        """Make later predictions fail with StateError."""
        self._is_loaded = False

    def check_loaded(self) -> None:
        """Raise StateError unless it is loaded."""
        if not self._is_loaded:
            raise StateError(
                f"The backend {self.name!r} was used before it was loaded.",
                hint="Call load() first.",
            )

    def follow(self, instruction: str) -> None:
        """Start a new episode if the instruction has changed."""
        if instruction != self._instruction:
            self.reset()
            self._instruction = instruction
