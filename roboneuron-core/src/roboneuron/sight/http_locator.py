"""The locator `http-locator`: a model behind an HTTP endpoint boxes, points at or places what it
sees.

Request, `POST` of JSON:

    {"labels": ["cup"], "images": [{"camera": "front", "format": "jpeg", "data": BASE64,
      "width": 640, "height": 480, "intrinsics": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
      "T_base_camera": 4 x 4}]}

Answer, status 200, JSON; each list may be missing:

    {"detections": [{"camera": "front", "label": "cup", "score": 0.9, "box": [l, t, r, b]},
                    {"camera": "front", "label": "cup", "point": [u, v]}],
     "objects": [{"label": "cup", "position_m": [x, y, z], "size_m": [l, w, h], "yaw_rad": null,
                  "symmetry_rad": 0, "uncertainty_m": 0.01, "cameras": ["front"]}]}

Pixels count from the left and the top of the image as it was sent, with centres at integers + 0.5.
"""

from __future__ import annotations

import base64
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from roboneuron import foreign
from roboneuron.contract.arrays import F64
from roboneuron.contract.locator import CalibratedImage, LocatedObject
from roboneuron.errors import ConfigurationError, ForeignDataError, StateError
from roboneuron.plugins.option_marks import ConfigurationOnly
from roboneuron.sight.boxes import ImageDetection, place_detections
from roboneuron.sight.endpoint import HttpEndpoint

_MOST_BYTES = 1 << 20
_MOST_FOUND, _MOST_LABEL = 256, 60
_WHAT = "the answer of the endpoint"
_Length = Annotated[float, Field(gt=0, le=5)]
_Place = Annotated[float, Field(ge=-20, le=20)]
_Pixel = Annotated[float, Field(ge=-1e5, le=1e5)]
_Label = Annotated[str, Field(min_length=1, max_length=1000)]


class HttpLocatorOptions(BaseModel):
    """Options of the locator `http-locator`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: Annotated[str, ConfigurationOnly()] = Field(
        default="",
        description="Endpoint of the model, such as http://127.0.0.1:8008/locate; has to be given.",
    )
    labels: tuple[Annotated[str, Field(min_length=1, max_length=100)], ...] = Field(
        default=(), max_length=64, description="What to look for; empty for whatever it knows."
    )
    limit_s: float = Field(default=5.0, gt=0, le=60, description="Longest time of an answer [s].")
    least_score: float = Field(default=0.3, ge=0, le=1, description="Less sure ones are left out.")
    format: Literal["jpeg", "png"] = Field(
        default="jpeg", description="jpeg is small, png is exact."
    )
    most_px: int = Field(
        default=1280, ge=64, le=4096, description="Larger pictures are scaled down to this side."
    )
    token_variable: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="Environment variable with a bearer token; empty for none."
    )
    usual_m: float = Field(
        default=0.05, gt=0, le=1, description="Size of what the model points at without a box [m]."
    )


class _DetectionEntry(BaseModel):
    """A detection in an answer."""

    camera: str
    label: _Label
    score: float = Field(default=1.0, ge=0, le=1)
    box: tuple[_Pixel, _Pixel, _Pixel, _Pixel] | None = None
    point: tuple[_Pixel, _Pixel] | None = None

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if (self.box is None) == (self.point is None):
            raise ValueError("a detection has a box or a point")
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise ValueError("a box is left, upper, right and lower edge")
        return self

    @property
    def edges(self) -> F64:
        """Its box (4,), without extent for a point."""
        return np.array(self.box if self.box is not None else (*(self.point or ()),) * 2)


class _Placed(BaseModel):
    """An object in an answer."""

    label: _Label
    position_m: tuple[_Place, _Place, _Place]
    size_m: tuple[_Length, _Length, _Length]
    yaw_rad: float | None = Field(default=None, ge=-7, le=7)
    symmetry_rad: float = Field(default=0.0, ge=0, le=2 * math.pi)
    uncertainty_m: _Length
    cameras: tuple[str, ...] = Field(min_length=1, max_length=64)


class _Answer(BaseModel):
    detections: tuple[_DetectionEntry, ...] = Field(default=(), max_length=_MOST_FOUND)
    objects: tuple[_Placed, ...] = Field(default=(), max_length=_MOST_FOUND)


@dataclass(frozen=True, kw_only=True, slots=True)
class _SentPicture:
    """A picture as it was sent.

    Attributes:
        scale: pixels of the picture for one that was sent.
    """

    image: CalibratedImage
    scale: float


class HttpLocator:
    """Implementation of `roboneuron.contract.locator.LabelLocator`.

    Depth images stay here: they place what the endpoint boxes, see `place_detections`.
    """

    def __init__(self, config: HttpLocatorOptions | None) -> None:
        self._options = config or HttpLocatorOptions()
        self._endpoint: HttpEndpoint | None = None

    def load(self) -> None:
        """See `Locator`; the endpoint is not asked. Raises ConfigurationError: the address is
        invalid, or the token is missing.
        """
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        variable = self._options.token_variable
        if variable:
            token = os.environ.get(variable, "")
            if not token or not token.isascii() or not token.isprintable():
                raise ConfigurationError(f"The environment has no usable {variable}.")
            headers["Authorization"] = f"Bearer {token}"
        self._endpoint = HttpEndpoint(self._options.url, headers)

    def close(self) -> None:
        """See `Locator`."""
        self._endpoint = None

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str] = ()
    ) -> Sequence[LocatedObject]:
        """See `LabelLocator`.

        Raises:
            NotReadyError: the endpoint cannot be reached, is late or answers with an error.
            ForeignDataError: its answer is too large or wrong.
            StateError: before `load` or after `close`.
        """
        if self._endpoint is None:
            raise StateError("The locator 'http-locator' is not loaded.")
        if not images:
            return []
        sent, parts = {}, []
        for image in images:
            part, scale = self._part(image)
            parts.append(part)
            sent[image.frame.camera] = _SentPicture(image=image, scale=scale)
        body = json.dumps({"labels": labels or self._options.labels, "images": parts}).encode()
        raw = self._endpoint.post(body, limit_s=self._options.limit_s, most_bytes=_MOST_BYTES)
        answer = foreign.decode_model(_Answer, raw, _WHAT, most_bytes=_MOST_BYTES)
        detections = [
            _detection(found, sent)
            for found in answer.detections
            if found.score >= self._options.least_score
        ]
        placed = place_detections(detections, usual_m=self._options.usual_m)
        return [*placed, *(_object(one, sent) for one in answer.objects)]

    def _part(self, image: CalibratedImage) -> tuple[dict[str, Any], float]:
        """A picture in the request, and its pixels for one that is sent."""
        from PIL import Image as Pillow  # heavy

        options = self._options
        picture = Pillow.fromarray(np.ascontiguousarray(image.frame.image))
        scale = max(1.0, max(picture.size) / options.most_px)
        size = (max(1, round(picture.width / scale)), max(1, round(picture.height / scale)))
        if scale > 1.0:
            picture = picture.resize(size, Pillow.Resampling.BILINEAR)
        buffer = io.BytesIO()
        if options.format == "png":
            picture.save(buffer, "PNG", compress_level=1)
        else:
            picture.save(buffer, "JPEG", quality=90)
        intrinsics = image.view.intrinsics.copy()
        intrinsics[:2] /= scale
        return {
            "camera": image.frame.camera,
            "format": options.format,
            "data": base64.b64encode(buffer.getvalue()).decode(),
            "width": size[0],
            "height": size[1],
            "intrinsics": intrinsics.tolist(),
            "T_base_camera": image.T_base_camera.tolist(),
        }, scale


def _shown(camera: str, sent: dict[str, _SentPicture]) -> _SentPicture:
    if camera not in sent:
        raise ForeignDataError(
            f"{_WHAT} names the camera {foreign.quoted(camera, _MOST_LABEL)}, sent were "
            f"{', '.join(sent)}."
        )
    return sent[camera]


def _detection(found: _DetectionEntry, sent: dict[str, _SentPicture]) -> ImageDetection:
    """Raises ForeignDataError."""
    shown = _shown(found.camera, sent)
    return ImageDetection(
        image=shown.image,
        label=foreign.printable(found.label, _MOST_LABEL),
        score=found.score,
        box_px=found.edges * shown.scale,
    )


def _object(placed: _Placed, sent: dict[str, _SentPicture]) -> LocatedObject:
    """Raises ForeignDataError."""
    frames = [_shown(camera, sent).image.frame for camera in placed.cameras]
    yaw = placed.yaw_rad
    return LocatedObject(
        label=foreign.printable(placed.label, _MOST_LABEL),
        position_m=np.array(placed.position_m),
        yaw_rad=None if yaw is None else math.remainder(yaw, 2 * math.pi),
        symmetry_rad=placed.symmetry_rad,
        size_m=np.array(placed.size_m),
        uncertainty_m=placed.uncertainty_m,
        cameras=tuple(dict.fromkeys(frame.camera for frame in frames)),
        seen_at_ns=min(frame.stamp_ns for frame in frames),
    )
