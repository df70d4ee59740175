"""A policy and its fallback, on a clock of the test."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np

from rn_testing.waiting import wait_until
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    Frame,
    Observation,
)
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.modules.inference.execution import ChunkExecutor, Prediction
from roboneuron.modules.inference.fallback import FallbackPolicies
from roboneuron.modules.inference.loaded import LoadedPolicy
from roboneuron.modules.predictions import PredictionRequest

HOLD_AFTER_S = 0.4
PERIOD_S = 0.1
FIRST, SECOND = 0.1, 0.2


class Clock:
    """Goes when a test says so."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


class Model:
    """A backend that answers when it may; the first number of its rows says whose they are."""

    def __init__(self, mark: float) -> None:
        self.mark = mark
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.error: Exception | None = None
        self.asked: list[Observation] = []
        self.resets = 0

    def load(self) -> None: ...

    def predict(self, observation: Observation) -> ActionChunk:
        self.asked.append(observation)
        assert self.may_answer.wait(30.0)
        if self.error is not None:
            raise self.error
        return ActionChunk(actions=np.full((4, 7), self.mark), step_s=0.05)

    def reset(self) -> None:
        self.resets += 1

    def close(self) -> None: ...


AGREED = SpaceAgreement(declared=EE_DELTA, executed=EE_DELTA, columns=tuple(range(7)))


def loaded(name: str, model: Model, *roles: str) -> LoadedPolicy:
    policy: Any = SimpleNamespace(
        backend=SimpleNamespace(name=name), cameras=dict.fromkeys(roles or ("primary",), "front")
    )
    return LoadedPolicy(policy=policy, backend=model, runtime=None, agreement=AGREED, load_s=0.0)


class Pair:
    """Two policies, and images that come ten times a second."""

    def __init__(self, clock: Clock, executor: ChunkExecutor, *roles: str) -> None:
        self.clock, self.executor = clock, executor
        self.first, self.second = Model(FIRST), Model(SECOND)
        self.values: dict[str, Any] = {}
        self.events: list[tuple[str, str]] = []
        status: Any = SimpleNamespace(
            set_value=self.values.__setitem__,
            tell=lambda *event: self.events.append(event),
            drop=lambda reason: None,
        )
        self.policies = FallbackPolicies(
            loaded("remote", self.first, "primary", *roles),
            loaded("local", self.second),
            executor,
            hold_after_s=HOLD_AFTER_S,
            max_age_s=0.5,
            status=status,
        )
        self.policies.on_wait = self.wait
        self.stop = threading.Event()
        self.is_new = True
        self.count = 0

    def wait(self) -> None:
        self.clock.now_s += 1.0

    def observe(self) -> Observation:
        self.clock.now_s += PERIOD_S
        self.count += 1
        image = np.zeros((4, 4, 3), dtype=np.uint8)
        roles = ("primary", "wrist")
        stamp_ns = int(self.clock.now_s * 1e9)
        frames = {
            role: Frame(camera=role, image=image, stamp_ns=stamp_ns, frame_id="c") for role in roles
        }
        return Observation(frames=frames, instruction="go", stamp_ns=stamp_ns)

    def ask(self) -> tuple[Prediction, ActionChunk] | None:
        """One image; what is to be executed for it."""
        observation = self.observe()
        prediction = self.executor.begin(observation, observation.stamp_ns)
        resets, self.is_new = self.is_new, False
        request = PredictionRequest(
            prediction=prediction, measured=observation, resets=resets, stop=self.stop
        )
        found = self.policies.predict(request, lambda _: None)
        return None if found is None else (found.prediction, found.chunk)

    def whose(self) -> float | None:
        """As `ask`; the mark of the answer."""
        found = self.ask()
        return None if found is None else float(found[1].actions[0, 0])

    def settle(self) -> None:
        """Until the first policy has answered what it was asked."""
        request = self.policies._request
        assert request is not None
        wait_until(request.answer.done, 10.0, "the first has answered")
