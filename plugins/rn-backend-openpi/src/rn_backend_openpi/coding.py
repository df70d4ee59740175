"""Images for transmission: shrunk to the model's input, and coded as the capacity of the link
allows and the effect on the actions.
"""

from __future__ import annotations

import io
import logging
import statistics
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi.messages import Document, from_observation, image_key
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    Frame,
    NotReadyError,
    Observation,
    RoboNeuronError,
)

log = logging.getLogger(__name__)
Coding = Literal["raw", "png", "jpeg"]
CODINGS: tuple[Coding, ...] = ("raw", "png", "jpeg")
"""Codings, from the largest data to the smallest; the last one is lossy."""
Size = tuple[int, int]
"""Width and height [px]."""
_PNG_LEVEL = 1
"""Higher levels take several times as long to save a few per cent."""
Ask = Callable[[Document, float], ActionChunk]
"""Sends an observation and returns the answer until a deadline (monotonic [s])."""
PARITY_S = 5.0
"""Longest wait for each answer of a parity check; nothing is executed meanwhile."""
_SAMPLES = 5
_AGREEING = 5
"""Number of consecutive equal choices before the coding changes."""
_PROBE = 100
"""Number of observations after which one is sent in the next larger coding, if the link may support
that: old measurements may no longer hold.
"""
_LINK = "shared.link_ms"


class LinkMeter:
    """Measures the cost of images on a link, and chooses the coding. Times are in seconds.

    Each coding is measured separately: a small image takes one round trip on any link, and gives no
    information about a larger one.
    """

    def __init__(self, share: float) -> None:
        self._share = share
        self._base_s: float | None = None
        self._sizes: dict[Coding, int] = {}
        self._coding_s: dict[Coding, float] = {}
        self._link_s: dict[Coding, deque[float]] = {}
        self.current: Coding = "raw"
        self._wanted: Coding = "raw"
        self._agreeing = 0

    def note_base(self, link_s: float) -> None:
        """Note a round trip of almost no data."""
        self._base_s = link_s if self._base_s is None else min(self._base_s, link_s)

    def note(self, coding: Coding, size: int, coding_s: float, link_s: float) -> None:
        """Note an answered observation.

        Args:
            coding: coding of its images.
            size: size of its images in bytes.
            coding_s: time taken by coding.
            link_s: its time on the link, both ways.
        """
        self.note_base(link_s)
        self._sizes[coding], self._coding_s[coding] = size, coding_s
        self._link_s.setdefault(coding, deque(maxlen=_SAMPLES)).append(link_s)

    def assume(self, coding: Coding, size: int) -> None:
        """Set the size of images in a coding that takes no time."""
        self._sizes.setdefault(coding, size)
        self._coding_s.setdefault(coding, 0.0)

    def cost_s(self, coding: Coding) -> float | None:
        """Time taken by images in a coding, beyond a round trip of almost no data; None if unknown.
        That of an unmeasured coding is scaled by size from the next smaller one.
        """
        if coding not in self._sizes:
            return None
        if coding in self._link_s:
            return self._coding_s[coding] + self._transfer_s(coding)
        for smaller in CODINGS[CODINGS.index(coding) + 1 :]:
            if smaller in self._link_s:
                return self._coding_s[coding] + self._scaled_s(coding, smaller)
        return None

    def _transfer_s(self, coding: Coding) -> float:
        assert self._base_s is not None
        return max(statistics.median(self._link_s[coding]) - self._base_s, 0.0)

    def _scaled_s(self, coding: Coding, measured: Coding) -> float:
        return self._transfer_s(measured) * self._sizes[coding] / self._sizes[measured]

    def choose(self, period_s: float, allowed: tuple[Coding, ...]) -> Coding:
        """The coding to use from now on: the first one within its share of a period, otherwise the
        cheapest.
        """
        known: dict[Coding, float | None] = {coding: self.cost_s(coding) for coding in allowed}
        costs = {coding: cost for coding, cost in known.items() if cost is not None}
        most_s = self._share * period_s
        fitting = [coding for coding, cost in costs.items() if cost <= most_s]
        least = min(costs, key=lambda coding: costs[coding], default=allowed[0])
        wanted = fitting[0] if fitting else least
        self._agreeing = self._agreeing + 1 if wanted == self._wanted else 1
        self._wanted = wanted
        if self.current not in allowed or self._agreeing >= _AGREEING:
            self.current = wanted
        return self.current

    def settle(self, period_s: float, allowed: tuple[Coding, ...]) -> None:
        """Choose immediately."""
        for _ in range(_AGREEING):
            self.choose(period_s, allowed)

    def probe(self, allowed: tuple[Coding, ...], most_s: float) -> Coding:
        """The next larger coding than the current one, if its images are estimated to take at most
        this time; deletes its older measurements.
        """
        larger = [one for one in CODINGS[: CODINGS.index(self.current)] if one in allowed]
        if not larger or larger[-1] not in self._sizes or self.current not in self._link_s:
            return self.current
        coding = larger[-1]
        if self._scaled_s(coding, self.current) > most_s:
            return self.current
        self._link_s.pop(coding, None)
        return coding


class Coder:
    """Sends images to our server, shrunk and coded according to the options; to one on this machine
    as they are.

    Args:
        options: of the policy.
        sizes: sizes to which the model shrinks images, by role or by name of the camera.
        base_s: a round trip of almost no data [s].
    """

    def __init__(self, options: PolicyOptions, sizes: Mapping[str, Size], base_s: float) -> None:
        self._options = options
        self._is_auto = options.coding == "auto" and not options.is_local
        self._sizes = {} if options.is_local else dict(sizes)
        self._meter = LinkMeter(options.link_share)
        self._meter.note_base(base_s)
        fixed: Coding = "raw" if options.is_local or options.coding == "auto" else options.coding
        self._allowed: tuple[Coding, ...] = CODINGS if self._is_auto else (fixed,)
        self._meter.current = fixed
        self._parity: dict[str, float] | None = None
        self._count = 0

    @property
    def coding(self) -> Coding:
        """Current coding of images."""
        return self._meter.current

    def ask(self, observation: Observation, ask: Ask, deadline_s: float) -> ActionChunk:
        """Request the answer to an observation. The first one is also sent with unchanged images if
        coding may affect the answer.

        Raises:
            ConfigurationError: the change of actions exceeds the options' limit, or the model keeps
                a history of observations.
            RoboNeuronError: as `ask`.
        """
        fitted = self._fitted(observation)
        if self._parity is None:
            self._parity = self._check(fitted, ask)
            deadline_s = time.monotonic() + self._options.timeout_s
        chunk = self._timed(fitted, self._next(), ask, deadline_s)
        if self._is_auto:
            self._choose(chunk)
        return chunk

    def _next(self) -> Coding:
        self._count += 1
        if self._is_auto and self._count % _PROBE == 0:
            return self._meter.probe(self._allowed, self._options.timeout_s / 4)
        return self.coding

    def _choose(self, chunk: ActionChunk) -> None:
        before = self.coding
        now = self._meter.choose(chunk.step_s, self._allowed)
        if now != before:
            log.info("Images are sent as %s from now on, before as %s.", now, before)

    def _fitted(self, observation: Observation) -> Observation:
        frames = {}
        for role, frame in observation.frames.items():
            size = self._sizes.get(role, self._sizes.get(frame.camera))
            frames[role] = frame if size is None else fit(frame, size)
        return replace(observation, frames=frames)

    def _timed(
        self, observation: Observation, coding: Coding, ask: Ask, deadline_s: float
    ) -> ActionChunk:
        begun_s = time.monotonic()
        document, size = from_observation(observation), 0
        for role, frame in observation.frames.items():
            coded = encode_image(frame.image, coding, self._options.quality)
            document[image_key(role)] = coded
            size += image_bytes(coded)
        coding_s = time.monotonic() - begun_s
        chunk = ask(document, deadline_s)
        self._meter.note(coding, size, coding_s, chunk.metrics[_LINK] / 1e3)
        own = {
            "shared.coding_ms": coding_s * 1e3,
            "shared.coding": float(CODINGS.index(coding)),
            "shared.image_kb": size / 1e3,
            **(self._parity or {}),
        }
        return replace(chunk, metrics={**chunk.metrics, **own})

    def _check(self, observation: Observation, ask: Ask) -> dict[str, float]:
        """Change of actions by JPEG, beyond their variation without it."""
        options = self._options
        if "jpeg" not in self._allowed:
            return {}

        def asked(coding: Coding) -> ActionChunk:
            return self._timed(observation, coding, ask, time.monotonic() + PARITY_S)

        first = asked("png")
        try:
            # twice, to exclude the model's own random variation
            as_is, coded = [first, asked("png")], asked("jpeg")
        except NotReadyError:
            raise
        except RoboNeuronError as error:
            raise _remembers(error) from error
        self._meter.assume("raw", sum(frame.image.nbytes for frame in observation.frames.values()))
        itself, moved = distances(*as_is), distances(as_is[0], coded)
        beyond = {unit: max(moved[unit] - itself[unit], 0.0) for unit in moved}
        log.info(
            "Coded images change actions by %.2g m and %.2g rad; repeated ones by %.2g m and %.2g "
            "rad.",
            *(moved["m"], moved["rad"], itself["m"], itself["rad"]),
        )
        limits = {"m": options.parity_m, "rad": options.parity_rad}
        excess = [unit for unit in limits if beyond[unit] > limits[unit]]
        if excess and options.coding == "jpeg":
            unit = excess[0]
            raise ConfigurationError(
                f"Actions change by {beyond[unit]:.3g} {unit} when images are coded as configured; "
                f"parity_{unit} = {limits[unit]:g} are allowed.",
                hint="Raise quality, use coding = 'png', or allow more.",
            )
        if excess:
            log.warning("JPEG is not used: it changes actions by more than is allowed.")
            self._allowed = CODINGS[:2]
        if self._is_auto:
            self._meter.settle(coded.step_s, self._allowed)
            log.info("Images are sent as %s.", self.coding)
        return {f"shared.parity_{unit}": beyond[unit] for unit in limits}


def _remembers(error: RoboNeuronError) -> ConfigurationError:
    return ConfigurationError(
        "The model answered an observation and refused the same one when it was repeated to "
        f"measure the effect of coded images: it keeps a history of observations. Error: {error}",
        hint="Such a model must not be served with stateless = true: it mixes robots up. For one "
        "robot alone set coding = 'raw' or 'png', which repeats no request.",
    )


def distances(one: ActionChunk, other: ActionChunk) -> dict[str, float]:
    """Largest difference of two chunks by unit, [m] and [rad] and their rates; infinite for chunks
    that cannot be compared.
    """
    if one.actions.shape != other.actions.shape or one.space != other.space:
        return {"m": np.inf, "rad": np.inf}
    apart = np.abs(one.actions - other.actions).max(axis=0)
    units = [channel.unit.removesuffix("/s") for channel in one.space.channels]
    return {
        unit: max((float(d) for d, u in zip(apart, units, strict=True) if u == unit), default=0.0)
        for unit in ("m", "rad")
    }


def fit(frame: Frame, size: Size) -> Frame:
    """Shrink the frame to a size, and adapt its calibration; a frame that is not larger is returned
    unchanged.

    The filter is Pillow's bilinear one, which averages over the merged pixels.
    """
    from PIL import Image  # heavy

    height, width = frame.image.shape[:2]
    if (width, height) == size or width < size[0] or height < size[1]:
        return frame
    image = Image.fromarray(frame.image).resize(size, Image.Resampling.BILINEAR)
    known = frame.calibration
    if known is not None:
        scale = np.diag([size[0] / width, size[1] / height, 1.0])
        known = replace(known, intrinsics=scale @ known.intrinsics)
    return replace(frame, image=np.asarray(image, dtype=np.uint8), calibration=known)


def encode_image(image: NDArray[np.uint8], coding: Coding, quality: int) -> object:
    """Encode an image for sending.

    Args:
        image: uint8 (H, W, 3), RGB.
        coding: `raw` keeps the image itself.
        quality: quality of JPEG, 1 .. 100.
    """
    if coding == "raw":
        return image
    from PIL import Image  # heavy

    made = io.BytesIO()
    if coding == "png":
        Image.fromarray(image).save(made, "png", compress_level=_PNG_LEVEL)
    else:
        # full colour resolution, because cubes are distinguished by colour
        Image.fromarray(image).save(made, "jpeg", quality=quality, subsampling=0)
    height, width = image.shape[:2]
    data = np.frombuffer(made.getbuffer(), dtype=np.uint8)
    return {"coding": coding, "height": height, "width": width, "data": data}


def image_bytes(image: object) -> int:
    """Size of a coded image in bytes."""
    data = image["data"] if isinstance(image, dict) else image
    return int(np.asarray(data).nbytes)
