"""`roboneuron-openvla`: creates tiny checkpoints to try the backend with."""

from __future__ import annotations

from collections.abc import Sequence

from rn_vla.openvla.command import MakeTiny, TinyCommand


def _load(_: str) -> MakeTiny:
    from rn_vla.openvla.tiny import make_tiny  # heavy: torch

    return make_tiny


COMMAND = TinyCommand(
    program="roboneuron-openvla",
    model="OpenVLA",
    options='profile = "libero"',
    load=_load,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    return COMMAND.run(arguments)
