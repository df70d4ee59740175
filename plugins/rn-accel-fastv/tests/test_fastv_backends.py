"""Presets with whole models, and combinations that planning refuses."""

from __future__ import annotations

import gc
import subprocess
import sys

import numpy as np
import pytest

from rn_accel_fastv.config import FastVConfig, PresetConfig
from rn_accel_fastv.plugin import roboneuron_accelerations
from rn_accel_fastv.preset import FastV, FastVP25, FastVP50, FastVP75
from rn_accel_fastv.selection import AttendedTokens
from rn_backend_oft.backend import OftBackend
from rn_backend_oft.config import OftConfig
from rn_backend_oft.plugin import roboneuron_backends as oft_backends
from rn_backend_oft.tiny import make_tiny_oft
from rn_backend_openvla.backend import OpenVlaBackend
from rn_backend_openvla.config import OpenVlaConfig
from rn_backend_openvla.plugin import roboneuron_backends as openvla_backends
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.plugin import roboneuron_runtimes
from rn_runtime_torch.runtime import TorchRuntime
from rn_testing.fakes import make_observation
from rn_vla.openvla.tiny import make_tiny
from roboneuron.errors import ConfigurationError, PlanningError
from roboneuron.modules.inference.planning import ResolvedPolicy
from roboneuron.plugins.registry import Offer, Registry, Status
from roboneuron.plugins.specs import BackendSpec, CameraSpec, DriverSpec, RobotSpec, RuntimeSpec

PRESETS = {"fastv-p25": FastVP25, "fastv-p50": FastVP50, "fastv-p75": FastVP75}
SHARES = {"fastv-p25": 0.75, "fastv-p50": 0.5, "fastv-p75": 0.25}


@pytest.fixture(scope="module")
def tinies(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    make_tiny(folder / "openvla")
    make_tiny_oft(folder / "oft")
    return folder


def _backend(folder, family, acceleration):
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    if family == "openvla":
        config = OpenVlaConfig(checkpoint=folder / family, profile="libero")
        backend = OpenVlaBackend(config, runtime=runtime, acceleration=acceleration)
    else:
        config = OftConfig(
            checkpoint=folder / family, profile="libero", constants="libero", proprio=True
        )
        backend = OftBackend(config, runtime=runtime, acceleration=acceleration)
    backend.load()
    return backend


SPECS = {"openvla": openvla_backends()[0], "oft": oft_backends()[0]}


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("family", ["openvla", "oft"])
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_each_preset_keeps_its_share_of_the_visual_tokens(tinies, family, preset):
    chunk = _backend(tinies, family, PRESETS[preset]()).predict(make_observation(SPECS[family]))
    visual = 256 if family == "openvla" else 512
    assert chunk.metrics["visual_tokens"] == visual
    assert chunk.metrics["tokens_kept"] == visual * SHARES[preset]


@pytest.mark.parametrize("family", ["openvla", "oft"])
def test_dropping_nothing_gives_bit_identical_actions(tinies, family):
    observation = make_observation(SPECS[family])
    plain = _backend(tinies, family, None).predict(observation).actions
    zero = _backend(tinies, family, FastV(FastVConfig(k=1, r=0.0))).predict(observation).actions
    assert np.array_equal(plain, zero)


def test_pruned_oft_actions_differ_but_depend_on_the_image_still(tinies):
    backend = _backend(tinies, "oft", FastVP75(PresetConfig(query="actions")))
    observation = make_observation(SPECS["oft"])
    plain = _backend(tinies, "oft", None).predict(observation).actions
    assert np.abs(backend.predict(observation).actions - plain).max() > 1e-6


def test_action_rows_as_query_are_refused_when_openvla_loads(tinies):
    with pytest.raises(ConfigurationError, match="OpenVLA-OFT"):
        _backend(tinies, "openvla", FastVP50(PresetConfig(query="actions")))


def test_proprioception_and_words_are_never_dropped(tinies):
    kept = []
    select = AttendedTokens.select

    def spy(self, view):
        kept.append((view, select(self, view)))
        return kept[-1][1]

    preset = FastVP75()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(AttendedTokens, "select", spy)
        _backend(tinies, "oft", preset).predict(make_observation(SPECS["oft"]))
    view, positions = kept[-1]
    count = view.key.shape[2]
    assert view.visual_count == 512
    assert positions.tolist() == sorted(positions.tolist())
    assert positions[0] == 0
    assert positions[129:].tolist() == list(range(513, count))  # 513 is the proprio token


def _runtime(backend):
    """The runtime of the backend."""
    return backend._runtime


CYCLE = ("fastv-p25", "fastv-p50", None, "fastv-p75")


def _made(name):
    return None if name is None else PRESETS[name]()


@pytest.mark.parametrize("family", ["openvla", "oft"])
def test_a_preset_changed_in_place_gives_the_numbers_of_a_fresh_load(tinies, family):
    observation = make_observation(SPECS[family])
    fresh = {name: _backend(tinies, family, _made(name)).predict(observation) for name in CYCLE}
    assert len({chunk.metrics["tokens_kept"] for chunk in fresh.values()}) == len(CYCLE)
    running = _backend(tinies, family, FastVP50())
    for name in (*CYCLE, *reversed(CYCLE)):
        _runtime(running).set_acceleration(_made(name))
        chunk = running.predict(observation)
        assert chunk.metrics["tokens_kept"] == fresh[name].metrics["tokens_kept"]
        assert np.array_equal(chunk.actions, fresh[name].actions), name


@pytest.mark.exhaustive
@pytest.mark.parametrize("family", ["openvla", "oft"])
def test_50_changes_read_no_file_and_hold_no_more_memory(tinies, family, monkeypatch):
    import torch

    def held_bytes():
        gc.collect()
        tensors = [found for found in gc.get_objects() if issubclass(type(found), torch.Tensor)]
        return sum(
            {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values()
        )

    observation = make_observation(SPECS[family])
    backend = _backend(tinies, family, FastVP50())
    monkeypatch.setattr(
        "rn_runtime_torch.engine.load_shards", lambda *_: pytest.fail("weights were read again")
    )
    weights = [
        parameter.data_ptr() for parameter in _runtime(backend)._engine._decoder.parameters()
    ]
    before = 0
    for count in range(54):
        _runtime(backend).set_acceleration(_made(CYCLE[count % len(CYCLE)]))
        backend.predict(observation)
        if count == len(CYCLE) - 1:  # buffers have reached their largest size
            before = held_bytes()
    assert held_bytes() == before
    assert [
        parameter.data_ptr() for parameter in _runtime(backend)._engine._decoder.parameters()
    ] == weights


@pytest.mark.parametrize(
    ("family", "unfit"),
    [
        ("openvla", FastVP25(PresetConfig(query="actions"))),
        ("openvla", FastVP25(PresetConfig(k=31))),
        ("oft", FastVP25(PresetConfig(k=31))),
    ],
)
def test_a_preset_that_does_not_fit_is_refused_and_the_former_one_stays(tinies, family, unfit):
    observation = make_observation(SPECS[family])
    backend = _backend(tinies, family, FastVP50())
    before = backend.predict(observation)
    with pytest.raises(ConfigurationError):
        _runtime(backend).set_acceleration(unfit)
    after = backend.predict(observation)
    assert after.metrics["tokens_kept"] == before.metrics["tokens_kept"]
    assert np.array_equal(after.actions, before.actions)


def _registry(*more) -> Registry:
    robot = RobotSpec(
        name="arm",
        summary="An arm.",
        target="x:y",
        drivers=(DriverSpec(name="simulated", summary="s", target="x:y"),),
        cameras=(CameraSpec(name="front", role="primary"), CameraSpec(name="hand", role="wrist")),
    )
    specs = (
        robot,
        *more,
        *roboneuron_accelerations(),
        *roboneuron_runtimes(),
        *openvla_backends(),
        *oft_backends(),
    )
    offers = tuple(
        Offer(spec=spec, plugin="test", distribution="test", status=Status.READY) for spec in specs
    )
    return Registry(plugins=(), all_offers=offers)


@pytest.mark.parametrize("backend", ["openvla", "openvla-tcp", "oft", "oft-primary"])
@pytest.mark.parametrize("preset", [*sorted(PRESETS), "fastv"])
def test_planning_accepts_the_presets_for_both_families(backend, preset):
    plan = ResolvedPolicy.of(
        _registry(), robot="arm", driver="simulated", backend=backend, acceleration=preset
    )
    assert plan.runtime.name == "torch"


def test_planning_refuses_the_presets_for_other_families():
    pi0 = BackendSpec(name="pi0", summary="s", target="x:y", family="pi0")
    with pytest.raises(PlanningError, match=r"fastv-p50.*openvla, openvla-oft.*pi0"):
        ResolvedPolicy.of(
            _registry(pi0), robot="arm", driver="simulated", backend="pi0", acceleration="fastv-p50"
        )


def test_planning_refuses_a_runtime_that_cannot_prune():
    served = RuntimeSpec(
        name="served",
        summary="s",
        target="x:y",
        families=("openvla",),
        capabilities=("token-decode",),
        served=True,
    )
    with pytest.raises(PlanningError, match=r"visual-token-pruning.*served.*fit: torch"):
        ResolvedPolicy.of(
            _registry(served),
            robot="arm",
            driver="simulated",
            backend="openvla",
            runtime="served",
            acceleration="fastv-p50",
        )


def test_planning_refuses_a_runtime_without_bidirectional_rows_for_oft():
    served = RuntimeSpec(
        name="served", summary="s", target="x:y", families=("openvla",), served=True
    )
    with pytest.raises(
        PlanningError, match=r"'served' executes the families openvla, but .*'openvla-oft'"
    ):
        ResolvedPolicy.of(
            _registry(served), robot="arm", driver="simulated", backend="oft", runtime="served"
        )


def test_building_backend_runtime_and_preset_does_not_import_torch():
    code = (
        "import sys, rn_backend_openvla.backend, rn_backend_oft.backend\n"
        "import rn_runtime_torch.runtime, rn_accel_fastv.preset\n"
        "rn_accel_fastv.preset.FastVP50(); rn_runtime_torch.runtime.TorchRuntime()\n"
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
