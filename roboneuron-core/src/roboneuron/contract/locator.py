"""Protocol of locators, their input and their result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from roboneuron.contract.arrays import F64, freeze
from roboneuron.contract.camera_view import CameraView
from roboneuron.contract.observation import Frame
from roboneuron.errors import InvalidInputError

MOST_LABELS, MOST_LABEL = 16, 60
"""Most labels in one question, and their most characters."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CalibratedImage:
    """One picture, and where its camera was at the time of capture.

    Attributes:
        frame: the picture, with its calibration, and its depth if there is one.
        T_base_camera: float64 (4, 4), pose of the optical frame in the base frame at
            `frame.stamp_ns` [m].
        table_m: height of the table's top in the base frame [m].

    Raises:
        InvalidInputError: the frame has no calibration, or the pose has another shape.
    """

    frame: Frame
    T_base_camera: F64
    table_m: float = 0.0

    def __post_init__(self) -> None:
        name = self.frame.camera
        if self.frame.calibration is None:
            raise InvalidInputError(f"The picture of camera {name!r} has no calibration.")
        if self.T_base_camera.shape != (4, 4) or not np.isfinite(self.T_base_camera).all():
            raise InvalidInputError(
                f"T_base_camera of {name!r} is {self.T_base_camera.shape}, expected finite (4, 4)."
            )

    @property
    def view(self) -> CameraView:
        """The pinhole camera."""
        assert self.frame.calibration is not None
        return CameraView(
            intrinsics=self.frame.calibration.intrinsics, T_base_camera=self.T_base_camera
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LocatedObject:
    """An object in the base frame.

    Attributes:
        label: what it is ("cube").
        colour: a colour word; empty if it has none.
        position_m: float64 (3,), centre.
        yaw_rad: direction of one of its faces about the vertical; None if not known.
        symmetry_rad: turn about the vertical after which it looks the same (a quarter turn for a
            cube); 0 for none.
        size_m: float64 (3,), along its own axes, the last vertical.
        uncertainty_m: the centre is within this distance with a probability of 95 %.
        cameras: names of the cameras that saw it, never empty.
        seen_at_ns: capture time of the oldest of their pictures, ROS clock [ns].
        is_whole: seen whole by one of them; otherwise partly hidden or cut by the picture's edge.
        is_height_assumed: taken to stand on the table, because one camera alone cannot tell.
    """

    label: str
    colour: str = ""
    position_m: F64
    yaw_rad: float | None = None
    symmetry_rad: float = 0.0
    size_m: F64
    uncertainty_m: float
    cameras: tuple[str, ...]
    seen_at_ns: int
    is_whole: bool = True
    is_height_assumed: bool = False

    def __post_init__(self) -> None:
        freeze(self, "position_m", "size_m")


@runtime_checkable
class Locator(Protocol):
    """Finds objects in pictures. Built as `target(config)`, used from one thread at a time.

    The same pictures give the same objects. A picture without objects, or none at all, gives an
    empty sequence; what cannot be placed is left out, never guessed.
    """

    def load(self) -> None:
        """Load what it needs; called once, before `locate`.

        Raises:
            CheckpointError, ConfigurationError, MissingDependencyError: it cannot work.
        """

    def locate(self, images: Sequence[CalibratedImage]) -> Sequence[LocatedObject]:
        """Find the objects that these pictures show, each once.

        Raises:
            NotReadyError, ForeignDataError: a model elsewhere does not answer in time, or wrongly.
            StateError: before `load` or after `close`.
        """

    def close(self) -> None:
        """Release everything; may be called twice and before `load`."""


class LabelLocator(Locator, Protocol):
    """A locator that looks for what a question names; its descriptor has `takes_labels`."""

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str] = ()
    ) -> Sequence[LocatedObject]:
        """See `Locator`.

        Args:
            images: calibrated pictures.
            labels: what to look for, each at most `MOST_LABEL` printable characters and at most
                `MOST_LABELS` of them: words of an agent, which command nothing. Empty for those of
                the configuration.
        """
