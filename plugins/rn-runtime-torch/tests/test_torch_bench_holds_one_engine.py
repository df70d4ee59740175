from __future__ import annotations

import importlib.util
import sys
import weakref
from dataclasses import replace
from pathlib import Path

import pytest

BENCH = Path(__file__).parents[3] / "benchmarks" / "bench_vla.py"


@pytest.fixture
def bench(monkeypatch):
    pytest.importorskip("transformers")
    spec = importlib.util.spec_from_file_location("bench_vla", BENCH)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(str(BENCH.parent))
    monkeypatch.setitem(sys.modules, "bench_vla", module)
    spec.loader.exec_module(module)
    models = sys.modules["vla_models"]
    small = replace(models.SMALL, hidden=48, intermediate=64, layers=3, heads=2, key_value_heads=2)
    monkeypatch.setattr(models, "SMALL", small)
    return module


@pytest.mark.exhaustive
def test_an_engine_is_gone_before_the_next_one_is_built(bench, monkeypatch, tmp_path, capsys):
    """On a GPU two engines of the real size would not fit; the plain loop has no weights of its
    own.
    """
    engines: list[weakref.ref] = []
    made = bench.Engine

    def build(*arguments):
        assert not [engine for engine in engines if engine() is not None]
        engine = made(*arguments)
        engines.append(weakref.ref(engine))
        return engine

    monkeypatch.setattr(bench, "Engine", build)
    monkeypatch.setattr(bench, "PRESETS", {"none": 0.0, "fastv-p50": 0.5})
    config = bench.TorchRuntimeConfig(device="cpu", dtype="float32", warm_prompt_tokens=(24, 24))
    run = bench.Bench(config=config, speed=bench.Speed(bandwidth=1e10, throughput=1e11), repeat=1)
    for name, checkpoint, model in bench.policies("small", tmp_path):
        run.run(name, checkpoint.vision, model)
    assert len(engines) == 2 * len(bench.PRESETS)
    assert capsys.readouterr().out.count("eager loop") == 2


@pytest.mark.exhaustive
def test_the_eager_loop_reads_the_engines_weights(bench, tmp_path):
    name, _, model = next(bench.policies("small", tmp_path))
    with bench.random_weights():
        engine = bench.Engine(model, bench.TorchRuntimeConfig(device="cpu", dtype="float32"), None)
    loop = bench.EagerLoop(engine, model)
    ours = {slot.data_ptr() for slot in engine._decoder.slots().values()}
    assert {parameter.data_ptr() for parameter in loop.llama.parameters()} == ours, name
