"""`roboneuron-oft`: tiny checkpoints to try the backend with."""

from __future__ import annotations

from collections.abc import Sequence

from rn_vla.openvla.command import MakeTiny, TinyCommand


def _load() -> MakeTiny:
    from rn_backend_oft.tiny import make_tiny_oft  # heavy: torch

    return make_tiny_oft


COMMAND = TinyCommand(
    program="roboneuron-oft",
    model="OpenVLA-OFT",
    options='profile = "libero", constants = "libero", proprio = true',
    load=_load,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return COMMAND.run(arguments)
