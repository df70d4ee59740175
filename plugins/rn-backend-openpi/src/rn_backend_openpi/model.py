"""The served backend: created in the same way as in the inference module, and called for several
robots at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast

from rn_backend_openpi.batching import Answer
from rn_backend_openpi.description import describe_arena
from rn_backend_openpi.interface import served_layout
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.layout import Layout
from rn_backend_openpi.options import ModelOptions
from rn_backend_openpi.space import space_of
from roboneuron import (
    EE_DELTA,
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
from roboneuron.command import discover
from roboneuron.feature import build, load_profile

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
        layout: interface for clients of openpi's kind; None without a profile.
    """

    def __init__(self, options: ModelOptions) -> None:
        self._options = options
        self._backend: Backend
        self._many: Many | None = None
        self.spec: BackendSpec
        self.layout: Layout | None = None

    def load(self) -> None:
        """Create and load the backend.

        Raises:
            ConfigurationError: it is not installed, cannot be shared, or an option is wrong.
            RoboNeuronError: as `Backend.load`.
        """
        self.spec, self._backend = self._built()
        self._many = getattr(self._backend, METHOD, None)
        if self._many is None and not self._options.stateless:
            raise ConfigurationError(
                f"The backend {self.spec.name!r} cannot answer several observations at once, and "
                "may remember robots.",
                hint="If it keeps no state from one observation to the next, set stateless = true "
                "for this model: observations are then answered one by one.",
            )
        self._backend.load()
        interface = self._options.interface
        if interface is not None and interface.profile is not None:
            self.layout = served_layout(interface, self.spec, self._space_for(interface))
            if interface.dialect == "roboarena":
                describe_arena(self.layout)  # a space without a name is found before any client

    def _space_for(self, interface: InterfaceOptions) -> ControlSpace:
        if interface.robot is not None:
            return self.space_on(load_profile(discover(), interface.robot))
        if self.spec.space is not None:
            raise ConfigurationError(
                f"The control space of backend {self.spec.name!r} depends on the robot.",
                hint="Name it in `interface`: robot = ...",
            )
        return EE_DELTA

    def _built(self) -> tuple[BackendSpec, Backend]:
        """The backend that the options name, not loaded, and its descriptor."""
        options, registry = self._options, discover()
        if options.backend is None:
            raise ConfigurationError("The option `backend` of the shared model is not set.")
        spec = registry.get(BackendSpec, options.backend)
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
        return spec, cast("Backend", build(spec, own, **parts))

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
