"""For each rule of locators there is a locator that breaks it: one that guesses, invents, remembers
or is slow.
"""

from __future__ import annotations

import os
import threading
import time
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_testing.locator_case import LocatorCase
from rn_testing.rule import RuleVerdict
from rn_testing.rules import rules_of
from rn_testing.rules.locator import LIFECYCLE
from rn_testing.verification import verify
from roboneuron.sight.colours import ColourLocator, ColoursOptions
from roboneuron.sight.plugin import LOCATORS


class Good(ColourLocator):
    """The good one, what it finds changed."""

    def change(self, found: list[Any]) -> Any:
        return found

    def locate(self, images: Any) -> Any:
        return self.change(list(super().locate(images)))


class FindsNothing(Good):
    def change(self, found):
        return []


class IsOffAndSure(Good):
    def change(self, found):
        return [replace(one, position_m=one.position_m + 0.004) for one in found]


class FindsTwice(Good):
    def change(self, found):
        return found + found


class TurnsTheWrongWay(Good):
    def change(self, found):
        return [replace(one, yaw_rad=-one.yaw_rad) for one in found]


class Invents(Good):
    def locate(self, images):
        stamp = replace(self.something, cameras=(images[0].frame.camera,)) if images else None
        return list(super().locate(images)) or ([stamp] if stamp else [])

    @property
    def something(self):
        locator = ColourLocator(None)
        locator.load()
        return locator.locate(LocatorCase(spec=LOCATORS[0]).pictures())[0]


class SeesInTheDark(Invents):
    def locate(self, images):
        return ColourLocator.locate(self, images) if images else [self.something]


class IsNotFinite(Good):
    def change(self, found):
        return [replace(one, size_m=np.full(3, np.nan)) for one in found]


class IsCertain(Good):
    def change(self, found):
        return [replace(one, uncertainty_m=0.0) for one in found]


class NamesNoCamera(Good):
    def change(self, found):
        return [replace(one, cameras=()) for one in found]


class IsFromTheNewest(Good):
    def change(self, found):
        return [replace(one, seen_at_ns=7) for one in found]


class Drifts(Good):
    count = 0

    def change(self, found):
        self.count += 1
        return [replace(one, uncertainty_m=one.uncertainty_m + self.count) for one in found]


class BelievesTheFirst(Good):
    def locate(self, images):
        place = 0.01 * (images[0].frame.camera == "side") if images else 0.0
        return [replace(one, position_m=one.position_m + place) for one in super().locate(images)]


class TellsTheCamerasFrame(Good):
    def locate(self, images):
        found = super().locate(images)
        if not images:
            return found
        base = np.linalg.inv(images[0].T_base_camera)
        return [
            replace(one, position_m=base[:3, :3] @ one.position_m + base[:3, 3]) for one in found
        ]


class Paints(Good):
    def locate(self, images):
        for image in images:
            image.T_base_camera[0, 3] += 1e-6
        return super().locate(images)


class IsSlow(Good):
    def change(self, found):
        time.sleep(1.05)
        return found


class NoClose:
    def __init__(self, config):
        pass

    def load(self):
        pass

    def locate(self, images):
        return []


class ReadsAFile(Good):
    def __init__(self, config):
        open("/proc/self/status", "rb").close()
        super().__init__(config)


class IgnoresOptions(Good):
    def __init__(self, config):
        super().__init__(ColoursOptions())


class ClosesOnce(Good):
    is_closed = False

    def close(self):
        if self.is_closed:
            raise ValueError("closed")
        self.is_closed = True
        super().close()


class KeepsAFile(Good):
    def load(self):
        self.file = os.open("/dev/null", os.O_RDONLY)
        super().load()


class LoadsOnce(Good):
    def load(self):
        if self._is_loaded:
            raise ValueError("loaded")
        super().load()


class FailsAfterClose(Good):
    was_closed = False

    def load(self):
        if self.was_closed:
            raise ValueError("closed")
        super().load()

    def close(self):
        self.was_closed = self._is_loaded
        super().close()


class Collects(Good):
    def change(self, found):
        self.kept = [*getattr(self, "kept", []), np.ones(300_000)]
        return found


class ChangesTheFolder(Good):
    def load(self):
        os.chdir("/")
        super().load()


class TellsTheEnvironment(Good):
    def locate(self, images):
        if not self._is_loaded:
            raise ValueError(str(dict(os.environ)))
        return super().locate(images)


class AlwaysReady(Good):
    def locate(self, images):
        self._is_loaded = True
        return super().locate(images)


class NeedsContiguousPictures(Good):
    def locate(self, images):
        for one in images:
            one.frame.image.view().shape = (-1,)
        return super().locate(images)


class SharesPlaces(Good):
    places: dict[int, np.ndarray] = {}  # noqa: RUF012

    def change(self, found):
        for number, one in enumerate(found):
            place = self.places.setdefault(number, np.zeros(3))
            place[:] = one.position_m
            object.__setattr__(one, "position_m", place)
        return found


class WarnsEachTime(Good):
    def locate(self, images):
        warnings.warn("slow", stacklevel=2)
        return super().locate(images)


class WorksInOneThread(Good):
    def load(self):
        self.thread = threading.get_ident()
        super().load()

    def locate(self, images):
        if self._is_loaded and self.thread != threading.get_ident():
            raise RuntimeError("called from another thread")
        return super().locate(images)


MUTANTS: list[tuple[str, type]] = [
    ("protocol", NoClose),
    ("constructor-pure", ReadsAFile),
    ("options-read", IgnoresOptions),
    ("close-before-load", ClosesOnce),
    ("close-releases", KeepsAFile),
    ("second-load-safe", LoadsOnce),
    ("load-after-close", FailsAfterClose),
    ("memory-bounded", Collects),
    ("process-left-alone", ChangesTheFolder),
    ("errors-readable", TellsTheEnvironment),
    ("locate-before-load-refused", AlwaysReady),
    ("locate-after-close-refused", AlwaysReady),
    ("objects-found", FindsNothing),
    ("objects-found", IsOffAndSure),
    ("objects-found", FindsTwice),
    ("yaw-told", TurnsTheWrongWay),
    ("nothing-invented", Invents),
    ("blind-finds-nothing", SeesInTheDark),
    ("objects-have-their-form", IsNotFinite),
    ("objects-have-their-form", IsCertain),
    ("objects-have-their-form", NamesNoCamera),
    ("objects-have-their-form", IsFromTheNewest),
    ("repeatable", Drifts),
    ("order-means-nothing", BelievesTheFirst),
    ("base-frame", TellsTheCamerasFrame),
    ("pictures-kept", Paints),
    ("locate-quick", IsSlow),
    ("any-layout", NeedsContiguousPictures),
    ("answers-kept", SharesPlaces),
    ("quiet", WarnsEachTime),
    ("any-thread", WorksInOneThread),
]
WITHOUT_FILES = {"missing-file-refused"}
"""Rules about options that `colours` does not have; the kit's own tests break them."""


def broken_case(target: type, monkeypatch: pytest.MonkeyPatch) -> LocatorCase:
    """The good case with the class as its target."""
    monkeypatch.setattr(LocatorCase, "_target", lambda self, descriptor: target)
    return LocatorCase(spec=LOCATORS[0])


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize(
    ("name", "target"), MUTANTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_broken_locator_fails_its_rule(name, target, monkeypatch):
    rule = next(rule for rule in rules_of("locator") if rule.id == f"locator/{name}")
    assert verify(rule, LocatorCase(spec=LOCATORS[0])).verdict is RuleVerdict.PASSED
    outcome = verify(rule, broken_case(target, monkeypatch))
    assert outcome.verdict is RuleVerdict.FAILED, outcome
    assert outcome.detail


def test_every_rule_has_a_locator_that_breaks_it():
    own = {rule.id for rule in rules_of("locator") if rule.id.startswith(f"{LIFECYCLE.subject}/")}
    assert {f"locator/{name}" for name in {name for name, _ in MUTANTS} | WITHOUT_FILES} == own
