"""Memory of a model besides its weights, and the times of recordings, without a CUDA device."""

from __future__ import annotations

import contextlib
import dataclasses
import functools

import pytest
import torch
from pydantic import ValidationError

from rn_runtime_torch import device as device_module
from rn_runtime_torch import graph as graph_module
from rn_runtime_torch.config import MOST_RECORDINGS, TorchRuntimeConfig
from rn_runtime_torch.device import Needs, check_fits
from rn_runtime_torch.engine import Engine
from rn_runtime_torch.graph import GraphCache
from rn_runtime_torch.memory import PeakBytes
from rn_runtime_torch.runtime import TorchRuntime
from rn_runtime_torch.toy import EveryOtherToken
from roboneuron.errors import ConfigurationError, PluginError, StateError

CPU = TorchRuntimeConfig(device="cpu", dtype="float32")


def _engine_needs(toy, monkeypatch, model, config=CPU) -> Needs:
    seen = []
    monkeypatch.setattr(
        "rn_runtime_torch.engine.check_fits", lambda needs, device, dtype: seen.append(needs)
    )
    Engine(model, config, None)
    return seen[0]


def test_the_peak_counts_what_lives_at_once_and_not_what_lived_before():
    weight = torch.empty(1000, 1000, device="meta")
    with PeakBytes([weight]) as peak:
        row = torch.empty(1, 1000, device="meta")  # 4 kB
        for _ in range(3):
            row = row @ weight.t()  # one more row while the last one is still alive
        assert row.shape == (1, 1000)
    assert peak.peak == 8000


def test_the_peak_is_that_of_a_real_run(toy):
    """The allocator's bytes for the same pass differ only by alignment and attention's
    workspace.
    """

    def work(device: str) -> int:
        x = torch.ones(64, 1024, device=device)
        with PeakBytes([x]) as peak:
            torch.nn.functional.silu(torch.cat((x, x)) * 2.0).sum()
        return peak.peak

    assert work("meta") == work("cpu") > 2 * 64 * 1024 * 4


def test_keys_values_and_activations_are_counted_besides_weights(toy, monkeypatch):
    needs = _engine_needs(toy, monkeypatch, toy.model())
    positions, shape = 16 + 64 + 7, toy.shape
    assert (
        needs.cache == 2 * shape.layers * shape.key_value_heads * shape.head_width * positions * 4
    )
    assert needs.activations >= 2 * shape.intermediate * (16 + 64) * 4
    assert needs.recordings == 0


def test_longer_prompts_need_more(toy, monkeypatch):
    short, long = (
        _engine_needs(toy, monkeypatch, dataclasses.replace(toy.model(), max_prompt_tokens=count))
        for count in (16, 128)
    )
    assert long.weights == short.weights
    assert long.cache > short.cache
    assert long.activations > 2 * short.activations


def test_int8_copies_are_counted(toy, monkeypatch):
    plain = _engine_needs(toy, monkeypatch, toy.model())
    config = TorchRuntimeConfig(device="cpu", dtype="float32", decode_weights="int8")
    quantized = _engine_needs(toy, monkeypatch, toy.model(), config)
    shape = toy.shape
    matrices = (
        shape.heads * 2 + 2 * shape.key_value_heads
    ) * shape.head_width + 3 * shape.intermediate
    assert quantized.weights - plain.weights == shape.layers * matrices * shape.hidden


def test_what_does_not_fit_beside_the_weights_is_refused_with_its_parts(monkeypatch):
    monkeypatch.setattr(device_module, "free_bytes", lambda device: 16_000_000_000)
    needs = Needs(weights=15_000_000_000, cache=200_000_000, activations=300_000_000)
    check_fits(needs, torch.device("cpu"), torch.bfloat16)
    with pytest.raises(
        ConfigurationError, match=r"weights 15.00, keys and values 0.20, working memory 1.2"
    ):
        check_fits(dataclasses.replace(needs, recordings=29), torch.device("cuda"), torch.bfloat16)


def test_more_lengths_than_are_recorded_are_refused():
    TorchRuntimeConfig(warm_prompt_tokens=(1, MOST_RECORDINGS))
    with pytest.raises(ValidationError, match=f"spans {MOST_RECORDINGS + 1} lengths"):
        TorchRuntimeConfig(warm_prompt_tokens=(1, MOST_RECORDINGS + 1))


class FakeCuda:
    """The part of torch.cuda that recording uses: computes at once, and counts."""

    def __init__(self) -> None:
        self.streams = 0
        self.recorded_on: list[object] = []
        self.current = self

    def graph_pool_handle(self):
        return (0, 1)

    def Stream(self, device):
        self.streams += 1
        return self

    def wait_stream(self, other):
        pass

    def current_stream(self, device):
        return self

    def device(self, device):
        return contextlib.nullcontext()

    def stream(self, stream):
        return contextlib.nullcontext()

    def CUDAGraph(self):
        return self

    def replay(self):
        pass

    def graph(self, graph, pool, stream, capture_error_mode):
        self.recorded_on.append(stream)
        return contextlib.nullcontext()


def test_all_recordings_share_one_stream(monkeypatch):
    cuda = FakeCuda()
    monkeypatch.setattr(graph_module.torch, "cuda", cuda)
    cache = GraphCache(torch.device("cpu"))
    for length in range(5):
        cache.record(
            length, lambda held: {"y": held["x"] + 1}, {"x": torch.ones(length)}, lambda: 0
        )
    assert (len(cache), cuda.streams, len(cuda.recorded_on)) == (5, 1, 5)
    assert cache.run(3, {"x": torch.zeros(3)}) is not None
    assert cache.run(7, {"x": torch.zeros(7)}) is None


def test_lengths_outside_the_recorded_ones_run_and_are_not_recorded(toy, monkeypatch):
    """An engine on the CPU whose recordings are fakes: load records 8 to 10, requests record
    nothing.
    """
    engine, plain = (Engine(toy.model(), CPU, None) for _ in range(2))
    monkeypatch.setattr(graph_module.torch, "cuda", FakeCuda())
    engine._graphs = GraphCache(torch.device("cpu"))
    engine._recording = True
    for length in engine._warm_lengths(TorchRuntimeConfig(warm_prompt_tokens=(8, 10))):
        engine.answer(toy.token_request(length), lambda: None)
    engine._recording = False
    assert len(engine._graphs) == 3
    for length in (7, 11, 60):
        request, asked = toy.token_request(length), []
        reply = engine.answer(request, functools.partial(asked.append, length))
        assert reply.note == f"CUDA graph: eager, prompt of {length} tokens (recorded: 8 to 10)."
        assert reply.metrics["recorded"] == 0.0
        assert len(asked) == 6  # between tokens: an unrecorded request can be aborted
        assert reply.tokens.tolist() == plain.answer(request, lambda: None).tokens.tolist()
    assert len(engine._graphs) == 3
    assert engine.answer(toy.token_request(9), lambda: None).note == ""


def with_fake_graphs(toy, monkeypatch, config=CPU) -> Engine:
    """An engine on the CPU that records with a fake, and has recorded a prompt of 9 tokens without
    a preset.
    """
    engine = Engine(toy.model(), config, None)
    monkeypatch.setattr(graph_module.torch, "cuda", FakeCuda())
    engine._graphs = GraphCache(torch.device("cpu"))
    engine._recording = True
    engine.answer(toy.token_request(9), lambda: None)
    engine._recording = False
    return engine


def test_a_change_of_preset_records_the_prompt_length_in_use(toy, monkeypatch):
    engine = with_fake_graphs(toy, monkeypatch)
    engine.answer(toy.token_request(11), lambda: None)
    engine.set_acceleration(EqualSelection())
    assert len(engine._graphs) == 2
    assert engine.answer(toy.token_request(11), lambda: None).metrics["recorded"] == 1.0
    other = engine.answer(toy.token_request(9), lambda: None)
    assert (other.metrics["recorded"], other.note) == (
        0.0,
        "CUDA graph: eager, prompt of 9 tokens (recorded: 11 only).",
    )
    for preset in (None, EqualSelection(), None):  # existing recordings are not repeated
        engine.answer(toy.token_request(9 if preset is None else 11), lambda: None)
        engine.set_acceleration(preset)
    assert len(engine._graphs) <= 4


def test_a_change_records_nothing_when_told_not_to_and_says_so(toy, monkeypatch):
    config = TorchRuntimeConfig(device="cpu", dtype="float32", record_at_change=False)
    engine = with_fake_graphs(toy, monkeypatch, config)
    engine.set_acceleration(EqualSelection())
    assert len(engine._graphs) == 1
    reply = engine.answer(toy.token_request(9), lambda: None)
    assert reply.note == "CUDA graph: eager, none is recorded for the current preset."


def test_there_are_never_more_recordings_than_may_be(toy, monkeypatch):
    monkeypatch.setattr("rn_runtime_torch.engine.MOST_RECORDINGS", 1)
    engine = with_fake_graphs(toy, monkeypatch)
    engine.set_acceleration(EqualSelection())
    assert len(engine._graphs) == 1
    assert "none is recorded" in engine.answer(toy.token_request(9), lambda: None).note


def test_without_graphs_there_is_nothing_to_tell(toy):
    assert Engine(toy.model(), CPU, None).answer(toy.token_request(60), lambda: None).note == ""


def test_batches_say_that_they_run_eagerly(toy, monkeypatch):
    engine = with_fake_graphs(toy, monkeypatch)
    replies = engine.answer_batch([toy.rows_request(), toy.rows_request()], lambda: None)
    assert {(reply.note, reply.metrics["recorded"]) for reply in replies} == {
        ("CUDA graph: eager, batch of 2.", 0.0)
    }


@pytest.mark.parametrize(("shortest", "lengths"), [(18, (18, 46)), (50, (50, 64))])
def test_load_records_from_the_shortest_prompt_that_the_template_makes(
    toy, monkeypatch, shortest, lengths
):
    engine = with_fake_graphs(toy, monkeypatch)
    engine._model = dataclasses.replace(toy.model(), min_prompt_tokens=shortest)
    found = engine._warm_lengths(CPU)
    assert (found[0], found[-1]) == lengths
    explicit = engine._warm_lengths(TorchRuntimeConfig(warm_prompt_tokens=(20, 22)))
    assert list(explicit) == [20, 21, 22]


class EqualSelection(EveryOtherToken):
    """Equal to every other selection of its class."""

    def __eq__(self, other):
        return type(other) is EqualSelection

    def __hash__(self):
        return 1


def test_recordings_belong_to_the_preset_that_they_were_made_with(toy, monkeypatch):
    """Recordings are fakes that compute nothing when replayed, so a wrong one would give another
    request's tokens.
    """
    plain, pruned = (Engine(toy.model(), CPU, preset) for preset in (None, EqualSelection()))
    engine = Engine(toy.model(), CPU, EqualSelection())
    monkeypatch.setattr(graph_module.torch, "cuda", FakeCuda())
    engine._graphs = GraphCache(torch.device("cpu"))
    engine._recording = True
    request = toy.token_request(9)
    engine.answer(request, lambda: None)
    engine._recording = False
    engine._records_at_change = False
    for preset, alone, recorded in (
        (None, plain, 0.0),
        (EqualSelection(), pruned, 1.0),
        (None, plain, 0.0),
    ):
        engine.set_acceleration(preset)
        reply, expected = engine.answer(request, lambda: None), alone.answer(request, lambda: None)
        assert reply.metrics["recorded"] == recorded
        assert reply.metrics["tokens_kept"] == expected.metrics["tokens_kept"]
        assert reply.logits.tolist() == expected.logits.tolist()
    assert len(engine._graphs) == 1


class KeepsNoWord(EveryOtherToken):
    """Drops the last position, which is a text token."""

    def select(self, view):
        return super().select(view)[:-1]


def test_a_selection_that_drops_words_is_refused_before_any_request(toy):
    engine = Engine(toy.model(), CPU, None)
    before = engine.answer(toy.token_request(), lambda: None)
    with pytest.raises(PluginError, match="every one that holds no image patch"):
        engine.set_acceleration(KeepsNoWord())
    assert (
        engine.answer(toy.token_request(), lambda: None).logits.tolist() == before.logits.tolist()
    )


def test_compiled_layers_keep_their_preset(toy, monkeypatch):
    monkeypatch.setattr("rn_runtime_torch.engine._compile", lambda decoder: None)
    engine = Engine(
        toy.model(),
        TorchRuntimeConfig(device="cpu", dtype="float32", compile=True),
        EveryOtherToken(),
    )
    before = engine._decoder.selection
    with pytest.raises(ConfigurationError, match="compile"):
        engine.set_acceleration(None)
    assert engine._decoder.selection is before is not None


def test_there_is_nothing_to_accelerate_before_load_and_after_close(toy):
    runtime = TorchRuntime(CPU)
    with pytest.raises(StateError):
        runtime.set_acceleration(None)
    runtime.load(toy.model())
    runtime.set_acceleration(None)
    runtime.close()
    with pytest.raises(StateError):
        runtime.set_acceleration(None)


def test_the_fake_selection_makes_its_positions_on_the_device(toy):
    """CUDA refuses a host list inside a recording; tensors on "meta" refuse it too."""
    from rn_vla.pruning import AttentionView

    key = torch.empty(1, 2, 30, 8, device="meta")
    view = AttentionView(
        query=key, key=key, visual_start=1, visual_count=16, rows=None, causal=True
    )
    assert EveryOtherToken().select(view).shape == (22,)
    real = torch.empty(1, 2, 30, 8)
    view = dataclasses.replace(view, query=real, key=real)
    assert EveryOtherToken().select(view).tolist() == [0, *range(1, 17, 2), *range(17, 30)]
