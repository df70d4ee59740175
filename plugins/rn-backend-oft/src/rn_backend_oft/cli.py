"""`roboneuron-oft`: creates tiny checkpoints to try the backend with."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from rn_backend_oft.constants import CONSTANTS
from rn_vla.openvla.command import MakeTiny, TinyCommand


def _load(platform: str) -> MakeTiny:
    from rn_backend_oft.tiny import make_tiny_oft  # heavy: torch

    return functools.partial(make_tiny_oft, platform=platform)


COMMAND = TinyCommand(
    program="roboneuron-oft",
    model="OpenVLA-OFT",
    options='constants = "{}", the profile that belongs to it, proprio = true',
    load=_load,
    platforms=tuple(CONSTANTS),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return COMMAND.run(arguments)
