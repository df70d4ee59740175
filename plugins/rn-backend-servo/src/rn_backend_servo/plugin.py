"""Descriptors of this package: the backends "servo" and "servo-pair"."""

from __future__ import annotations

from collections.abc import Sequence

from rn_backend_servo.instruction import VERBS
from roboneuron import ActionSpace, BackendSpec, Verb, hookimpl

MAX_ROWS = 32
"""Largest value of the option `rows`."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backends "servo" and "servo-pair"."""
    return [
        BackendSpec(
            name="servo",
            summary="Picks up the cube named by its colour, by classical visual servoing; no "
            "weights, no GPU",
            target="rn_backend_servo.backend:ServoBackend",
            config="rn_backend_servo.options:ServoOptions",
            case="rn_backend_servo.case:contract_case",
            cameras=("primary",),
            optional_cameras=("wrist",),
            needs_state=True,
            action_space=ActionSpace(horizon=MAX_ROWS, step_s=0.1),
            conditions_on_rows=True,
            verbs=(Verb(words=VERBS, achieves="lifted"),),
        ),
        BackendSpec(
            name="servo-pair",
            summary="Hands a cube from arm to arm, by classical visual servoing",
            target="rn_backend_servo.pair_backend:HandOverBackend",
            config="rn_backend_servo.options:HandOverOptions",
            case="rn_backend_servo.case:pair_case",
            cameras=("primary",),
            optional_cameras=("wrist", "right_wrist"),
            needs_state=True,
            space="rn_backend_servo.pair_backend:hand_over_space",
        ),
    ]
