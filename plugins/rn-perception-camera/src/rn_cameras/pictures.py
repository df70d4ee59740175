"""A folder with the pictures of a calibration and what was measured with them.

`view-*.png` show the board in any pose, `still-*.png` the board that lies where its corners were
measured; `measured.json` has the joints and the corners. A person may put pictures in by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from roboneuron import ConfigurationError, ForeignDataError, InvalidInputError, foreign

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

MEASURED = "measured.json"
VIEW, STILL = "view", "still"
_KINDS = (".png", ".jpg", ".jpeg")
_MOST_PX = 64_000_000


class MeasuredFile(BaseModel):
    """Content of `measured.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    intrinsics: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] | None = Field(
        default=None,
        description="fx, fy, cx, cy [px, pixel centres at integers] that the camera's driver tells "
        "of these pictures, which do not distort; measured here when null",
    )
    joints: dict[str, dict[str, FiniteFloat]] = Field(
        default_factory=dict, description="measured joints [rad or m] by name, by picture"
    )
    corners: dict[
        Annotated[int, Field(ge=1, le=4)], tuple[FiniteFloat, FiniteFloat, FiniteFloat]
    ] = Field(
        default_factory=dict,
        description="positions of the board's outer corners in the base frame [m]",
    )


class PictureFolder:
    """The folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def names(self, kind: str) -> list[str]:
        """Names of its pictures whose name begins with `kind`; of all if it is empty."""
        found = [one.name for one in self.path.glob(f"{kind}*") if one.suffix.lower() in _KINDS]
        return sorted(found)

    def read(self, name: str) -> U8:
        """A picture: uint8 (H, W, 3). Raises InvalidInputError if it is none."""
        try:
            with Image.open(self.path / name) as picture:
                if picture.width * picture.height > _MOST_PX:
                    raise InvalidInputError(f"{name} has {picture.width}x{picture.height} pixels.")
                return np.array(picture.convert("RGB"))
        except (UnidentifiedImageError, OSError, SyntaxError) as error:
            raise InvalidInputError(f"{name} is no picture that can be read: {error}.") from error

    def add(self, kind: str, picture: U8) -> str:
        """Keep a picture under the next free name, which is returned. Raises OSError."""
        self.path.mkdir(parents=True, exist_ok=True)
        number = len(self.names(kind)) + 1
        while (path := self.path / f"{kind}-{number:03d}.png").exists():
            number += 1
        Image.fromarray(picture).save(path)
        return path.name

    def measured(self) -> MeasuredFile:
        """What was measured; nothing without the file. Raises ConfigurationError."""
        path = self.path / MEASURED
        try:
            return foreign.decode_model(MeasuredFile, foreign.read_bytes(path), str(path))
        except FileNotFoundError:
            return MeasuredFile()
        except ForeignDataError as error:
            raise ConfigurationError(f"{path}: {error.message}.", hint=error.hint) from error

    def note(self, measured: MeasuredFile) -> None:
        """Keep what was measured. Raises OSError."""
        self.path.mkdir(parents=True, exist_ok=True)
        text = measured.model_dump_json(indent=1) + "\n"
        (self.path / MEASURED).write_text(text, encoding="utf-8")


def as_arrays(corners: Mapping[int, tuple[float, float, float]]) -> dict[int, F64]:
    """Positions [m] by number of the corner."""
    return {number: np.array(place) for number, place in corners.items()}
