"""A monitor behind an HTTP endpoint, such as a vision-language model or a reward model."""

from __future__ import annotations

import base64
import http.client
import io
import json
import os
from typing import Annotated
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from rn_standard.tasks.monitor import Score
from roboneuron import (
    ConfigurationError,
    ConfigurationOnly,
    ForeignDataError,
    Frame,
    Observation,
    foreign,
)

_MOST_BYTES = 65_536
_MOST_TEXT = 200
_QUALITY = 85


class HttpJudgeOptions(BaseModel):
    """Options of `http-judge`, in `[tasks.monitor.options]`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    url: Annotated[str, ConfigurationOnly()] = Field(
        pattern=r"^https?://", description="where pictures and instruction are sent to (POST)"
    )
    token_env: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="environment variable with a bearer token; none when empty"
    )
    timeout_s: Annotated[float, Field(gt=0, le=4.5)] = Field(
        default=4.0, description="longest wait for the endpoint [s]"
    )
    side_px: Annotated[int, Field(ge=32, le=2048)] = Field(
        default=512, description="longest side of the pictures; larger ones are made smaller"
    )


class HttpJudge:
    """Follows `Monitor`. Each question is one POST of JSON:

    `{"instruction", "tcp_position_m", "tcp_quaternion_xyzw", "gripper_open", "images", "before"}`;
    `images` and `before` (from the attempt's start) are lists of `{"role", "stamp_ns", "jpeg"}`
    with base64. The answer is `{"success": 0..1 or null, "progress", "failure", "reason"}`, all but
    `success` optional. Anything else is no answer.
    """

    def __init__(self, config: HttpJudgeOptions | None) -> None:
        """Raises ConfigurationError without an address."""
        if config is None:
            raise ConfigurationError(
                "http-judge has no address.", hint='[tasks.monitor.options] url = "https://..."'
            )
        self._options = config
        self._before: list[dict[str, object]] = []

    def reset(self, observation: Observation) -> None:
        """See `Monitor`."""
        self._before = self._images(observation)

    def score(self, observation: Observation) -> Score:
        """See `Monitor`; an endpoint that fails gives no value, with the reason."""
        if not observation.frames:
            return Score(value=None, reason="there is no picture")
        pose, opening = observation.ee_pose, observation.gripper_open
        question = {
            "instruction": observation.instruction,
            "tcp_position_m": None if pose is None else pose.position_m.tolist(),
            "tcp_quaternion_xyzw": None if pose is None else pose.quaternion_xyzw.tolist(),
            "gripper_open": opening,
            "images": self._images(observation),
            "before": self._before,
        }
        try:
            return parse_answer(self._post(json.dumps(question).encode()))
        except (OSError, http.client.HTTPException, ValueError, ForeignDataError) as error:
            text = str(error).splitlines()[0][:_MOST_TEXT] if str(error) else ""
            return Score(value=None, reason=f"the endpoint: {type(error).__name__} {text}".strip())

    def _post(self, body: bytes) -> bytes:
        parts = urlsplit(self._options.url)
        is_safe = parts.scheme == "https"
        kind = http.client.HTTPSConnection if is_safe else http.client.HTTPConnection
        connection = kind(parts.netloc, timeout=self._options.timeout_s)
        headers = {"Content-Type": "application/json"}
        if self._options.token_env:
            headers["Authorization"] = f"Bearer {os.environ.get(self._options.token_env, '')}"
        path = parts.path or "/"
        try:
            connection.request(
                "POST", f"{path}?{parts.query}" if parts.query else path, body, headers
            )
            answer = connection.getresponse()
            data = answer.read(_MOST_BYTES + 1)
        finally:
            connection.close()
        if answer.status != 200 or len(data) > _MOST_BYTES:
            raise ValueError(f"status {answer.status}, {len(data)} bytes")
        return data

    def _images(self, observation: Observation) -> list[dict[str, object]]:
        return [
            {
                "role": role,
                "stamp_ns": frame.stamp_ns,
                "jpeg": _jpeg(frame, self._options.side_px),
            }
            for role, frame in observation.frames.items()
        ]


def parse_answer(data: bytes) -> Score:
    """The score in an endpoint's answer. Raises ForeignDataError."""
    answer = foreign.table(foreign.decode_json(data, "the answer"), "the answer")
    foreign.field(answer, "success")
    value, progress, failure = (
        foreign.optional_number(answer.get(name), name, 0.0, 1.0)
        for name in ("success", "progress", "failure")
    )
    reason = answer.get("reason")
    text = reason if isinstance(reason, str) and reason.strip() else "the endpoint gave no reason"
    text = " ".join(text.split())[:_MOST_TEXT].rstrip(".")
    return Score(value=value, reason=text, progress=progress, failure=failure)


def _jpeg(frame: Frame, side_px: int) -> str:
    from PIL import Image as Pillow  # heavy

    image: NDArray[np.uint8] = frame.image
    picture = Pillow.fromarray(image)
    picture.thumbnail((side_px, side_px))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
