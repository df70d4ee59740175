"""The complete interface of a served policy: keys and values of a request, and the rows of an
answer. Client and server share it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi.conventions import NetworkUnits
from rn_backend_openpi.rows import Rows
from rn_backend_openpi.state import TermState
from rn_backend_openpi.wire import Value
from rn_vla.letterbox import Flip, fit_antialiased, flip_image
from rn_vla.rotation import F64
from roboneuron import (
    ActionChunk,
    Frame,
    InvalidInputError,
    Observation,
    PluginError,
    UngroundedError,
)

Axes = Literal["hwc", "chw"]
Size = tuple[int, int]
_MOST_NESTED = 4
_RATE_SHARE = 0.02
"""Relative tolerance between a chunk's period and the profile's: rates are given in whole Hz."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Layout:
    """Keys of requests and answers, with their meaning.

    Attributes:
        name: name of the profile.
        image_keys: key of each camera role's image; a dot separates nested maps.
        optional_roles: cameras whose images may be missing.
        image_size_px: height and width that images are fitted into; None for no scaling.
        axes: order of an image's axes on the wire.
        flip: converts upright images to the orientation of the training data.
        prompt_key: key of the instruction.
        state: codec of the measured state.
        rows: codec of the answer's rows.
        network: conversion for a server that has none, whose keys are never nested; or None.
    """

    name: str
    image_keys: Mapping[str, str]
    optional_roles: frozenset[str]
    image_size_px: Size | None
    axes: Axes
    flip: Flip
    prompt_key: str
    state: TermState
    rows: Rows
    network: NetworkUnits | None = None

    @property
    def served_width(self) -> int:
        """Number of values of a row in the client's answers."""
        padded = None if self.network is None else self.network.width
        return self.rows.width if padded is None else padded

    def rows_of(self, served: F64, observation: Observation) -> F64:
        """Convert served rows (H, served_width) to the contract's; raises as `Rows.to_contract`."""
        if self.network is not None:
            served = self.network.from_network(served, self.rows.width)
        return self.rows.to_contract(served, observation)

    def request_of(self, observation: Observation) -> dict[str, Value]:
        """The request that a client sends.

        Raises:
            UngroundedError: a camera or a part of the state is missing.
            UnsafeError: a measured value is not finite.
        """
        request: dict[str, Value] = {self.prompt_key: observation.instruction}
        state = self.state.build(observation)
        if self.network is not None:
            parts = [np.asarray(part, dtype=np.float64) for part in state.values()]
            state = {self.network.state_key: self.network.to_network(np.concatenate(parts))}
        for key, value in state.items():
            self._put(request, key, value)
        for role, key in self.image_keys.items():
            frame = observation.frames.get(role)
            if frame is None and role in self.optional_roles:
                continue
            if frame is None:
                have = ", ".join(observation.frames) or "none"
                raise UngroundedError(
                    f"The policy server needs a frame of the camera role {role!r}; the "
                    f"observation has: {have}.",
                    hint="Remove the role from image_keys if the served model does not need it.",
                )
            self._put(request, key, self._to_wire(frame.image))
        return request

    def _put(self, request: dict[str, Value], key: str, value: Value) -> None:
        """Set a value at a key whose dots separate nested maps, unless a network's are names."""
        *outer, last = key.split(".") if self.network is None else [key]
        at = request
        for name in outer:
            at = cast("dict[str, Value]", at.setdefault(name, {}))
        at[last] = value

    def _to_wire(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        turned = flip_image(image, self.flip)
        if self.image_size_px is not None:
            turned = fit_antialiased(turned, self.image_size_px)
        return np.ascontiguousarray(turned if self.axes == "hwc" else turned.transpose(2, 0, 1))

    def observation_of(
        self, request: Mapping[Any, object], *, needed: Collection[str], has_state: bool
    ) -> Observation:
        """Convert a request to the observation for a server's backend.

        Args:
            request: the decoded request.
            needed: required camera roles; others are optional.
            has_state: True if the state is required.

        Raises:
            InvalidInputError: an entry is missing or malformed.
            UnsafeError: a value of the state is not finite.
        """
        entries = dict(_flat(request))
        prompt = entries.get(self.prompt_key)
        if not isinstance(prompt, str) or not prompt.strip():
            raise InvalidInputError(f"The request has no text at {self.prompt_key!r}.")
        frames = {
            role: self._frame(entries, role, key)
            for role, key in self.image_keys.items()
            if role in needed or key in entries
        }
        if not has_state and not any(key in entries for key in self.state.keys):
            return Observation(frames=frames, instruction=prompt)
        measured = self.state.parse(entries)
        return Observation(
            frames=frames,
            instruction=prompt,
            joints=measured.joints,
            ee_pose=measured.ee_pose,
            gripper_open=measured.gripper_open,
            arms=measured.arms,
        )

    def reply_of(self, chunk: ActionChunk, observation: Observation) -> dict[str, Value]:
        """A server's answer.

        Raises:
            PluginError: the chunk has another control space or period than the interface.
            UngroundedError, UnsafeError: as `Rows.from_contract`.
        """
        rows = self.rows
        declared = rows.space
        if (chunk.space.kind, chunk.space.channels) != (declared.kind, declared.channels):
            raise PluginError(
                f"The backend answered in {chunk.space.label!r}, it declares {declared.label!r}."
            )
        if rows.step_s and abs(chunk.step_s / rows.step_s - 1.0) > _RATE_SHARE:
            raise PluginError(
                f"The backend answered with rows every {chunk.step_s:g} s, the profile "
                f"{self.name!r} has one every {rows.step_s:g} s."
            )
        return {
            "actions": rows.from_contract(np.asarray(chunk.actions), observation),
            "step_s": chunk.step_s,
            "policy_timing": {"infer_ms": float(chunk.metrics.get("shared.model_ms", 0.0))},
        }

    def _frame(self, entries: Mapping[str, object], role: str, key: str) -> Frame:
        image = entries.get(key)
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim != 3:
            what = "is missing" if image is None else "is no uint8 array with three axes"
            raise InvalidInputError(f"The request's image {key!r} (camera {role!r}) {what}.")
        upright = flip_image(image if self.axes == "hwc" else image.transpose(1, 2, 0), self.flip)
        return Frame(
            camera=role, image=np.ascontiguousarray(upright), stamp_ns=0, frame_id=f"{role}_optical"
        )


def _flat(
    request: Mapping[Any, object], prefix: str = "", left: int = _MOST_NESTED
) -> Iterator[tuple[str, object]]:
    """Entries by key, with a dot between the names of nested maps."""
    for name, value in request.items():
        if isinstance(value, dict) and left:
            yield from _flat(value, f"{prefix}{name}.", left - 1)
        else:
            yield f"{prefix}{name}", value
