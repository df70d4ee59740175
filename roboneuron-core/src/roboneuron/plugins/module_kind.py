"""Descriptor of a kind of modules that a feature adds; standard library only."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class ModuleKindSpec:
    """A kind of modules that a feature adds to robot, perception, inference and control: a process
    of its own with tools that start and stop it.

    Attributes:
        title, start_text: title and effect of its start tool.
        proof: evidence of a successful start: what is so when the module is ready.
        stop_text: effect of its stop tool.
        inputs: kinds of modules that provide its inputs; its start waits for them, and fails
            without them.
    """

    title: str
    start_text: str
    proof: str
    stop_text: str
    inputs: tuple[str, ...] = ()
