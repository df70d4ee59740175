"""One model for many episodes: concurrent requests become one forward pass of the shipped
backend.
"""

from __future__ import annotations

import asyncio
import dataclasses

import numpy as np
import pytest

from rn_eval.command import _pool
from rn_eval.plan import EvalPlan
from rn_eval.policy import load_backend
from rn_eval.sharing import PolicyActor
from rn_testing.fakes import make_observation
from roboneuron import ConfigurationError, UngroundedError
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover

torch = pytest.importorskip("torch")
oft_plugin = pytest.importorskip("rn_backend_oft.plugin")
INSTRUCTIONS = ("pick up the red cube", "go", "put the small yellow cube into the bowl", "lift it")


@pytest.fixture
def plan_of_oft(tmp_path):
    """A tiny checkpoint with random weights, in the suite `cubes`."""
    from rn_backend_oft.tiny import make_tiny_oft

    torch.set_num_threads(1)
    make_tiny_oft(tmp_path / "tiny")
    config = load_config(None).model_dump(mode="json")
    config["plugins"]["oft-primary"] = {"profile": "libero", "constants": "libero", "proprio": True}
    config["plugins"]["torch"] = {"device": "cpu", "dtype": "float32"}
    return EvalPlan(
        suite="cubes",
        backend="oft-primary",
        checkpoint=str(tmp_path / "tiny"),
        config=config,
        episodes=1,
        shared_policy=True,
    )


@pytest.fixture
def observations():
    spec = oft_plugin.roboneuron_backends()[1]
    return [make_observation(spec, instruction) for instruction in INSTRUCTIONS]


async def _ask(actor, observations):
    await actor.open("none")
    answers = await asyncio.gather(
        *(actor.predict("none", observation) for observation in observations),
        return_exceptions=True,
    )
    return answers, await actor.sizes()


def test_four_episodes_are_answered_by_one_forward(plan_of_oft, observations):
    answers, sizes = asyncio.run(_ask(PolicyActor(plan_of_oft.model_dump_json()), observations))
    assert sizes == [4]
    own = load_backend(plan_of_oft, discover(), "none")
    for observation, answer in zip(observations, answers, strict=True):
        assert answer.metrics["batch"] == 4.0
        np.testing.assert_allclose(
            answer.actions, own.predict(observation).actions, rtol=0, atol=1e-5
        )


def test_a_bad_observation_fails_alone(plan_of_oft, observations):
    blind = dataclasses.replace(observations[1], frames={})
    answers, sizes = asyncio.run(
        _ask(PolicyActor(plan_of_oft.model_dump_json()), [observations[0], blind])
    )
    assert isinstance(answers[1], UngroundedError)
    assert answers[0].actions.shape == (8, 7)
    assert sizes == [1]


def test_a_run_of_own_policies_is_not_continued_with_batches(plan_of_oft):
    """Its episodes repeat bit for bit; batched ones do not."""
    from argparse import Namespace

    arguments = Namespace(policy_actors=1, workers=1, ray_address=None, policy_gpus=0.0)
    _pool(plan_of_oft, arguments)
    with pytest.raises(ConfigurationError, match="begun without --policy-actors"):
        _pool(plan_of_oft.model_copy(update={"shared_policy": False}), arguments)
    assert plan_of_oft.identity["shared_policy"]
