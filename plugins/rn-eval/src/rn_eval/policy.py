"""The policy of a worker: a backend in its own process, or one that many workers share and that
answers in batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast, runtime_checkable

from rn_eval.plan import EvalPlan
from rn_standard.inference.agreement import SpaceAgreement
from roboneuron import ActionChunk, Backend, Observation
from roboneuron.command import Registry, build


class EpisodePolicy(Protocol):
    """What an episode needs of a backend."""

    def predict(self, observation: Observation) -> ActionChunk:
        """As `Backend.predict`."""
        ...

    def reset(self) -> None:
        """Forget the episode before."""
        ...

    def close(self) -> None:
        """Release everything."""
        ...


@runtime_checkable
class BatchBackend(Protocol):
    """What a backend may offer beside `Backend`: one forward for the observations of many episodes.

    Offering it says that predictions depend on the observation alone: nothing is remembered between
    two of them.
    """

    def predict_batch(self, observations: Sequence[Observation]) -> Sequence[ActionChunk]:
        """One chunk for each observation, in their order."""
        ...


class AgreedPolicy:
    """A policy whose chunks come in the space that control executes.

    Args:
        policy: yields what it has declared; closed by its owner.
        agreement: on its space.
    """

    def __init__(self, policy: EpisodePolicy, agreement: SpaceAgreement) -> None:
        self._policy, self._agreement = policy, agreement
        self.reset, self.close = policy.reset, policy.close

    def predict(self, observation: Observation) -> ActionChunk:
        """As `Backend.predict`; raises InvalidInputError also for what was not agreed on."""
        return self._agreement.convert(self._policy.predict(observation), observation.joints)


def load_backend(plan: EvalPlan, registry: Registry, preset: str) -> Backend:
    """Build and load the backend with that preset, as the inference module does.

    Raises:
        RoboNeuronError: as planning, building and loading do.
    """
    parts = plan.check(registry, preset)
    config = plan.load_config()
    options = dict(config.options(parts.backend.name))
    if plan.checkpoint is not None:
        options["checkpoint"] = plan.checkpoint
    built: dict[str, object] = {
        part: None if chosen is None else build(chosen, config.options(chosen.name))
        for part, chosen in (("runtime", parts.runtime), ("acceleration", parts.acceleration))
    }
    backend = cast("Backend", build(parts.backend, options, **built))
    backend.load()
    return backend
