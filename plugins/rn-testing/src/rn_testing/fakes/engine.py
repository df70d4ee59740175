"""A runtime and an acceleration of the family "fake": decoding counts words, pruning counts
fewer.
"""

from __future__ import annotations

from dataclasses import dataclass

from roboneuron import Acceleration, AccelerationSpec, InvalidInputError, RuntimeSpec, StateError

FAMILY = "fake"
"""Model family of the fakes."""
PRUNING = "visual-token-pruning"
"""Capability that the fake acceleration needs and the fake runtime offers."""


@dataclass
class FakeDecoder:
    """The part that the fake acceleration changes: the fraction of prompt tokens kept."""

    kept_fraction: float = 1.0


class CountingRuntime:
    """Follows the protocol `Runtime`: `load` accepts any text as model, `run` counts the tokens of
    a request.
    """

    def __init__(self, config: None) -> None:
        self._decoder: FakeDecoder | None = None

    def load(self, model: object, acceleration: Acceleration[FakeDecoder] | None = None) -> None:
        """Store the model's name. Raises InvalidInputError for anything else."""
        if not isinstance(model, str):
            raise InvalidInputError(f"The model is {type(model).__name__}, expected its name.")
        decoder = FakeDecoder()
        if acceleration is not None:
            acceleration.apply(decoder)
        self._decoder = decoder

    def run(self, request: object) -> object:
        """Number of words kept. Raises StateError unless loaded, InvalidInputError for anything but
        text.
        """
        if self._decoder is None:
            raise StateError("The runtime is not loaded; call load() first.")
        if not isinstance(request, str):
            raise InvalidInputError(f"The request is {type(request).__name__}, expected text.")
        return round(len(request.split()) * self._decoder.kept_fraction)

    def abort(self) -> None:
        """Do nothing; no run takes long."""

    def close(self) -> None:
        """Unload."""
        self._decoder = None


class HalvingAcceleration:
    """Follows the protocol `Acceleration`: keeps half of the tokens."""

    def __init__(self, config: None) -> None:
        self._kept_fraction = 0.5

    def apply(self, decoder: object) -> None:
        """Raises InvalidInputError unless `decoder` is a FakeDecoder."""
        if not isinstance(decoder, FakeDecoder):
            raise InvalidInputError(
                f"The decoder is {type(decoder).__name__}, expected FakeDecoder."
            )
        decoder.kept_fraction = self._kept_fraction


FAKE_RUNTIME = RuntimeSpec(
    name="counting",
    summary="Counts the words of a request.",
    target="rn_testing.fakes.engine:CountingRuntime",
    families=(FAMILY,),
    capabilities=(PRUNING,),
)
"""Descriptor of the fake runtime."""

FAKE_ACCELERATION = AccelerationSpec(
    name="halving",
    summary="Keeps half of the tokens.",
    target="rn_testing.fakes.engine:HalvingAcceleration",
    families=(FAMILY,),
    capability=PRUNING,
)
"""Descriptor of the fake acceleration."""
