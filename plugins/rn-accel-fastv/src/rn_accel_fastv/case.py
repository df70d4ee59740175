"""The presets' contract cases: each is installed into a small decoder of the in-process runtime."""

from __future__ import annotations

from rn_accel_fastv.plugin import roboneuron_accelerations
from rn_testing import AccelerationCase
from roboneuron import AccelerationSpec


def p25_case() -> AccelerationCase:
    """`fastv-p25`."""
    return _case(roboneuron_accelerations()[0], {})


def p50_case() -> AccelerationCase:
    """`fastv-p50`."""
    return _case(roboneuron_accelerations()[1], {})


def p75_case() -> AccelerationCase:
    """`fastv-p75`."""
    return _case(roboneuron_accelerations()[2], {})


def free_case() -> AccelerationCase:
    """`fastv` with a third dropped after one layer."""
    return _case(roboneuron_accelerations()[3], {"k": 1, "r": 1 / 3})


def _case(spec: AccelerationSpec, options: dict[str, object]) -> AccelerationCase:
    def decoder() -> object:
        from rn_runtime_torch.decoder import Decoder  # heavy: torch
        from rn_vla.decoding import DecoderShape

        shape = DecoderShape(
            hidden=8,
            intermediate=8,
            layers=3,
            heads=2,
            key_value_heads=2,
            vocabulary=16,
            norm_epsilon=1e-6,
            rope_theta=10000.0,
            max_positions=32,
        )
        return Decoder(shape, 9)

    return AccelerationCase(spec=spec, options=options, decoder=decoder)
