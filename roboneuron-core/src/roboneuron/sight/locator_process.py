"""A locator in a process of its own: no import, crash or delay of it is the server's."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import cast

from roboneuron import foreign
from roboneuron.answering_process import AnsweringProcess
from roboneuron.contract.locator import CalibratedImage, LabelLocator, LocatedObject, Locator
from roboneuron.errors import ForeignDataError, NotReadyError, RoboNeuronError, StateError
from roboneuron.hang_watch import LOADING_S
from roboneuron.modules.plugin import build
from roboneuron.plugins.specs import LocatorSpec

MOST_FOUND = 256
"""Most objects in one answer."""
_LOOK_S = 0.5
"""How long a question waits for a locator that still loads."""


class LocatorProcess:
    """Implementation of `roboneuron.contract.locator.LabelLocator`.

    `load` starts the process and does not wait: until the locator is loaded, `locate` raises
    NotReadyError. A process that has ended is started anew by the next `locate`.
    """

    def __init__(self, spec: LocatorSpec, options: Mapping[str, object]) -> None:
        self._spec, self._options = spec, dict(options)
        self._process: AnsweringProcess | None = None
        self._is_loaded = self._is_loading = False
        self._began_s = 0.0

    def load(self) -> None:
        """Start the process. Raises NotReadyError."""
        self._end()
        self._is_loaded, self._is_loading, self._began_s = True, True, time.monotonic()
        self._process = AnsweringProcess(
            f"The locator {self._spec.name!r}",
            "roboneuron.sight.locator_process:ServedLocator",
            hang_s=LOADING_S,
        )
        end_s = self._began_s + self._spec.limit_s
        self._process.begin("load", self._spec, self._options, end_s=end_s)

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str] = ()
    ) -> Sequence[LocatedObject]:
        """See `LabelLocator`.

        Raises:
            RoboNeuronError: as the locator.
            NotReadyError: it still loads, has ended, or has not answered within `limit_s`.
            ForeignDataError: it answered anything but objects in these pictures.
        """
        if not self._is_loaded:
            raise StateError(f"The locator {self._spec.name!r} is not loaded.")
        if self._process is None or not self._process.is_alive:
            self.load()
        assert self._process is not None
        if self._is_loading:
            self._await_load(self._process)
        end_s = time.monotonic() + self._spec.limit_s
        found = self._process.ask("locate", tuple(images), tuple(labels), end_s=end_s)
        return _checked(found, {image.frame.camera for image in images}, self._spec.name)

    def close(self) -> None:
        """See `Locator`."""
        self._is_loaded = False
        self._end()

    def _end(self) -> None:
        if self._process is not None:
            self._process.end()
        self._process = None

    def _await_load(self, process: AnsweringProcess) -> None:
        """Raises RoboNeuronError: it still loads, or cannot; it is then loaded anew next time."""
        last_s = self._began_s + self._spec.load_s
        try:
            has_loaded = process.has_answer(min(last_s, time.monotonic() + _LOOK_S))
            if has_loaded:
                process.answer(last_s)
        except RoboNeuronError:
            self._end()
            raise
        self._is_loading = not has_loaded
        if has_loaded:
            return
        if time.monotonic() >= last_s:
            self._end()
            raise NotReadyError(
                f"The locator {self._spec.name!r} did not load within {self._spec.load_s:g} s."
            )
        raise NotReadyError(
            f"The locator {self._spec.name!r} still loads its model, for "
            f"{time.monotonic() - self._began_s:.0f} s now.",
            hint="Call look again.",
        )


class ServedLocator:
    """The locator in its process."""

    def __init__(self) -> None:
        self._locator: Locator | None = None

    def load(self, spec: LocatorSpec, options: Mapping[str, object]) -> None:
        """Build and load it. Raises RoboNeuronError."""
        self._takes_labels = spec.takes_labels
        locator = cast("Locator", build(spec, options))
        locator.load()
        self._locator = locator

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str]
    ) -> tuple[LocatedObject, ...]:
        """See `LabelLocator`."""
        if self._locator is None:
            raise StateError("The locator is not loaded.")
        if self._takes_labels:
            return tuple(cast("LabelLocator", self._locator).locate(images, labels))
        return tuple(self._locator.locate(images))


def _checked(found: object, cameras: set[str], name: str) -> Sequence[LocatedObject]:
    """The answer, if it is one."""
    if not isinstance(found, tuple) or not all(isinstance(one, LocatedObject) for one in found):
        raise ForeignDataError(f"The locator {name!r} answered no objects.")
    if len(found) > MOST_FOUND:
        raise ForeignDataError(f"The locator {name!r} tells {len(found)} objects.")
    other = {camera for one in found for camera in one.cameras} - cameras
    if other:
        told = foreign.quoted(min(other), 60)
        raise ForeignDataError(f"The locator {name!r} names the camera {told}.")
    return found
