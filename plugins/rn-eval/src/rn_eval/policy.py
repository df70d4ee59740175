"""Policies of workers: a backend in the worker's process, or one shared by many workers that
answers in batches.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast, runtime_checkable

from rn_eval.plan import EvalPlan
from roboneuron import ActionChunk, Backend, Observation
from roboneuron.feature import Registry, build
from roboneuron.modules.inference.agreement import SpaceAgreement


class EpisodePolicy(Protocol):
    """The part of a backend that an episode uses."""

    def predict(self, observation: Observation) -> ActionChunk:
        """Like `Backend.predict`."""
        ...

    def reset(self) -> None:
        """Clear the state of the previous episode."""
        ...

    def close(self) -> None:
        """Release everything."""
        ...


@runtime_checkable
class BatchBackend(Protocol):
    """Optional extension of `Backend`: one forward pass for the observations of many episodes.

    A backend that offers it declares that predictions depend on the observation only, without state
    between them.
    """

    def predict_batch(self, observations: Sequence[Observation]) -> Sequence[ActionChunk]:
        """Return one chunk per observation, in their order."""
        ...


class AgreedPolicy:
    """A policy whose chunks are converted to the space that control executes.

    Args:
        policy: the policy with its declared space; closed by its owner.
        agreement: agreement on the space.
    """

    def __init__(self, policy: EpisodePolicy, agreement: SpaceAgreement) -> None:
        self._policy, self._agreement = policy, agreement
        self.reset, self.close = policy.reset, policy.close

    def predict(self, observation: Observation) -> ActionChunk:
        """Like `Backend.predict`; also raises InvalidInputError for a chunk outside the
        agreement.
        """
        return self._agreement.convert(self._policy.predict(observation), observation.joints)


def load_backend(plan: EvalPlan, registry: Registry, preset: str) -> Backend:
    """Build and load the backend with a preset, as the inference module does.

    Raises:
        RoboNeuronError: planning, building or loading failed.
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
