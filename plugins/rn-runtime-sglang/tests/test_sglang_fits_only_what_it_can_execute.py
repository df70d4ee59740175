from __future__ import annotations

import pytest

from rn_runtime_sglang.plugin import roboneuron_runtimes
from roboneuron.errors import ConfigurationError, PlanningError
from roboneuron.modules.inference.planning import ResolvedPolicy
from roboneuron.plugins.discovery import discover


@pytest.fixture(scope="module")
def registry():
    return discover()


def plan(registry, backend, **parts):
    return ResolvedPolicy.of(registry, robot="fr3", driver="simulated", backend=backend, **parts)


def test_openvla_runs_with_it(registry):
    assert plan(registry, "openvla", runtime="sglang").runtime == roboneuron_runtimes()[0]


@pytest.mark.parametrize("preset", ["fastv-p25", "fastv-p50", "fastv-p75", "fastv"])
def test_dropping_visual_tokens_is_refused_with_the_reason(registry, preset):
    with pytest.raises(
        PlanningError,
        match=r"'visual-token-pruning', but runtime 'sglang' runs the model in another",
    ):
        plan(registry, "openvla", runtime="sglang", acceleration=preset)


def test_bidirectional_oft_is_refused(registry):
    with pytest.raises(PlanningError, match="executes the families openvla, but backend 'oft'"):
        plan(registry, "oft", runtime="sglang")


def test_pi0_is_refused_because_its_own_remote_route_serves_it(registry):
    with pytest.raises(PlanningError, match="'sglang'"):
        plan(registry, "pi0", runtime="sglang")


def test_an_acceleration_is_refused_at_load_too(launch, model):
    from rn_runtime_sglang.config import SglangRuntimeConfig
    from rn_runtime_sglang.runtime import SglangRuntime

    runtime = SglangRuntime(SglangRuntimeConfig(urls=(launch().url,)))
    with pytest.raises(ConfigurationError, match="takes no acceleration"):
        runtime.load(model, acceleration=object())  # type: ignore[arg-type]
