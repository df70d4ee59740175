"""The served backend: created in the same way as in the inference module, and called for several
robots at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

from rn_backend_openpi.batching import Answer
from rn_backend_openpi.shared_options import SharedOptions
from rn_backend_openpi.shared_space import space_of
from roboneuron import (
    AccelerationSpec,
    ActionChunk,
    Backend,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    Observation,
    RoboNeuronError,
    RobotProfile,
    RuntimeSpec,
)
from roboneuron.command import build, discover

Many = Callable[[Sequence[Observation]], Sequence[ActionChunk]]
METHOD = "predict_batch"
"""Optional method of a backend: one chunk for each observation, in their order, from one forward
pass. Offering it declares that predictions depend only on the observation.
"""

SIZES = "image_sizes"
CONTINUES = "continues_rows"
"""Optional attribute of a loaded backend, besides its descriptor's `conditions_on_rows`: True if
this checkpoint continues rows.
"""


class SharedModel:
    """A loaded backend; `load`, `answer` and `close` on one thread.

    Attributes:
        spec: descriptor of the backend.
    """

    def __init__(self, options: SharedOptions) -> None:
        self._options = options
        self._backend: Backend
        self._many: Many | None = None
        self.spec: BackendSpec

    def load(self) -> None:
        """Create and load the backend.

        Raises:
            ConfigurationError: it is not installed, cannot be shared, or an option is wrong.
            RoboNeuronError: as `Backend.load`.
        """
        options, registry = self._options, discover()
        if options.backend is None:
            raise ConfigurationError("The option `backend` of the shared model is not set.")
        self.spec = spec = registry.get(BackendSpec, options.backend)
        runtime = options.runtime or spec.default_runtime
        parts: dict[str, object] = {"runtime": None, "acceleration": None}
        if runtime:
            parts["runtime"] = build(registry.get(RuntimeSpec, runtime), options.runtime_options)
        if options.acceleration is not None:
            chosen = registry.get(AccelerationSpec, options.acceleration)
            parts["acceleration"] = build(chosen, options.acceleration_options)
        own = dict(options.options)
        if options.checkpoint is not None:
            own["checkpoint"] = options.checkpoint
        self._backend = cast("Backend", build(spec, own, **parts))
        self._many = getattr(self._backend, METHOD, None)
        if self._many is None and not options.stateless:
            raise ConfigurationError(
                f"The backend {spec.name!r} cannot answer several observations at once, and may "
                "remember robots.",
                hint="If it keeps no state from one observation to the next, set stateless = "
                "true in "
                "[plugins.shared]: observations are then answered one by one.",
            )
        self._backend.load()

    @property
    def most(self) -> int:
        """Largest useful batch; 1 for a backend without batches."""
        return self._options.most if self._many is not None else 1

    @property
    def image_sizes(self) -> Mapping[str, tuple[int, int]]:
        """Attribute `image_sizes` of the backend: width and height [px], by role or name of the
        camera, to which it shrinks images with Pillow's bilinear filter.
        """
        return dict(getattr(self._backend, SIZES, {}))

    @property
    def continues_rows(self) -> bool:
        """True if it continues the rows ahead, with the context of an earlier chunk."""
        return bool(getattr(self._backend, CONTINUES, self.spec.conditions_on_rows))

    def space_on(self, profile: RobotProfile) -> ControlSpace:
        """The control space of its chunks on a robot.

        Raises:
            RoboNeuronError: the backend's error if it cannot move this robot.
        """
        return space_of(self.spec, self._options, profile)

    def answer(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        """One answer for each observation; an error in one observation affects only its own answer.

        Observations whose rows the model continues are answered one by one, because a batched
        forward pass continues none.
        """
        answers: dict[int, Answer] = {}
        together: list[int] = []
        for place, observation in enumerate(observations):
            if self._continues(observation):
                answers[place] = self._alone(observation)
            else:
                together.append(place)
        found = self._together([observations[place] for place in together])
        answers |= dict(zip(together, found, strict=True))
        return [answers[place] for place in range(len(observations))]

    def _continues(self, observation: Observation) -> bool:
        ahead = observation.ahead
        return self.continues_rows and ahead is not None and len(ahead.rows) > 0

    def _together(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        if self._many is not None and len(observations) > 1:
            try:
                return list(self._many(observations))
            except RoboNeuronError:
                pass  # answered one by one below, which shows the cause
        return [self._alone(observation) for observation in observations]

    def _alone(self, observation: Observation) -> Answer:
        try:
            return self._backend.predict(observation)
        except RoboNeuronError as error:
            return error

    def close(self) -> None:
        """Release the model."""
        self._backend.close()
