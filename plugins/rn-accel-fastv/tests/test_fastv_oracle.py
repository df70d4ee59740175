"""Pruning compared with an oracle that masks instead of dropping: plain eager attention, full
length.
"""

from __future__ import annotations

import pytest
import torch

from rn_accel_fastv.config import FastVConfig
from rn_accel_fastv.preset import FastV
from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.decoder import Decoder
from rn_vla.decoding import DecoderShape
from roboneuron.errors import ConfigurationError

VISUAL, TEXT = 24, 9
LENGTH = 1 + VISUAL + TEXT
ROWS = (LENGTH - 6, LENGTH - 2)
TOLERANCE = 2e-5
"""float32 through five layers, summed in another order; 1e-6 was measured."""


def _shape(key_value_heads: int) -> DecoderShape:
    return DecoderShape(
        hidden=32,
        intermediate=48,
        layers=5,
        heads=4,
        key_value_heads=key_value_heads,
        vocabulary=64,
        norm_epsilon=1e-6,
        rope_theta=10000.0,
        max_positions=128,
    )


@pytest.fixture(params=[4, 2], ids=["one key head per head", "shared key heads"])
def decoder(request) -> Decoder:
    torch.manual_seed(3)
    made = Decoder(_shape(request.param), VISUAL)
    for parameter in made.parameters():
        scale = parameter.shape[-1] ** -0.5 if parameter.ndim == 2 else 1.0
        parameter.data = torch.randn(parameter.shape) * scale
    made.embedding.data *= 4
    made.prepare_positions(torch.device("cpu"), torch.float32)
    return made.requires_grad_(False)


def _hidden() -> torch.Tensor:
    return torch.randn(1, LENGTH, 32, generator=torch.Generator().manual_seed(5))


class Oracle:
    """The language model with masks; `kept` are the positions visible to later layers."""

    def __init__(
        self, decoder: Decoder, k: int, r: float, causal: bool, rows: tuple[int, int]
    ) -> None:
        self.weights, self.shape = decoder.slots(), decoder.shape
        self.k, self.r, self.causal, self.rows = k, r, causal, rows
        self.kept: torch.Tensor | None = None

    def _norm(self, x: torch.Tensor, name: str) -> torch.Tensor:
        return (
            x
            * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.shape.norm_epsilon)
            * self.weights[name]
        )

    def _rotate(self, x: torch.Tensor) -> torch.Tensor:
        """Each pair (i, i + width / 2) is one complex number, rotated by its position."""
        half = self.shape.head_width // 2
        speeds = 10000.0 ** (-torch.arange(half) / half)
        turns = torch.polar(torch.ones(1), torch.outer(torch.arange(x.shape[1]), speeds))
        turned = torch.complex(x[..., :half], x[..., half:]) * turns
        return torch.cat([turned.real, turned.imag], dim=-1)

    def _attention(self, x: torch.Tensor, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        base = f"model.layers.{index}.self_attn."
        count, width = x.shape[0], self.shape.head_width

        def heads(name: str) -> torch.Tensor:
            return (
                (x @ self.weights[f"{base}{name}.weight"].T).view(count, -1, width).transpose(0, 1)
            )

        repeat = self.shape.heads // self.shape.key_value_heads
        query = self._rotate(heads("q_proj"))
        key = self._rotate(heads("k_proj")).repeat_interleave(repeat, 0)
        value = heads("v_proj").repeat_interleave(repeat, 0)
        allowed = (
            torch.ones(count, count).tril().bool()
            if self.causal
            else torch.ones(count, count).bool()
        )
        if index >= self.k and self.kept is not None:
            dropped = torch.ones(count).bool()
            dropped[self.kept] = False
            dropped[1 + VISUAL :] = False
            allowed = allowed & ~dropped
        scores = (query @ key.transpose(1, 2) / width**0.5).masked_fill(~allowed, -torch.inf)
        probabilities = scores.softmax(-1)
        mixed = (probabilities @ value).transpose(0, 1).reshape(count, -1)
        return mixed @ self.weights[f"{base}o_proj.weight"].T, probabilities

    def run(self, hidden: torch.Tensor) -> torch.Tensor:
        x = hidden[0]
        for index in range(self.shape.layers):
            base = f"model.layers.{index}."
            mixed, probabilities = self._attention(
                self._norm(x, f"{base}input_layernorm.weight"), index
            )
            x = x + mixed
            y = self._norm(x, f"{base}post_attention_layernorm.weight")
            gate, up = (y @ self.weights[f"{base}mlp.{n}_proj.weight"].T for n in ("gate", "up"))
            x = (
                x
                + (torch.nn.functional.silu(gate) * up)
                @ self.weights[f"{base}mlp.down_proj.weight"].T
            )
            if index == self.k - 1 and self.kept is None:
                seen = probabilities[:, self.rows[0] : self.rows[1], 1 : 1 + VISUAL].mean((0, 1))
                best = seen.argsort(descending=True)[: round(VISUAL * (1 - self.r))] + 1
                self.kept = torch.cat([torch.tensor([0]), best.sort().values])
        return self._norm(x, "model.norm.weight")

    def whole(self, count: int) -> torch.Tensor:
        assert self.kept is not None
        return torch.cat([self.kept, torch.arange(1 + VISUAL, count)])


@pytest.mark.parametrize("r", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("k", [1, 2, 4])
def test_prefill_and_decode_equal_masking_the_dropped_tokens(decoder, k, r):
    FastV(FastVConfig(k=k, r=r)).apply(decoder)
    cache = KeyValueCache(decoder.shape, LENGTH + 4, torch.device("cpu"), torch.float32)
    hidden = _hidden()
    oracle = Oracle(decoder, k, r, True, (LENGTH - 1, LENGTH))
    got, expected = decoder(hidden, causal=True, cache=cache)[0], oracle.run(hidden)
    torch.testing.assert_close(got, expected[oracle.whole(LENGTH)], atol=TOLERANCE, rtol=0)
    assert [cache.used(i) for i in range(5)] == [LENGTH] * k + [len(oracle.whole(LENGTH))] * (5 - k)
    for step, token in enumerate((7, 11, 13)):
        new = decoder.embed(torch.tensor([[token]]))
        hidden = torch.cat([hidden, new], dim=1)
        got = decoder.step(new, LENGTH + step, cache)[0, 0]
        torch.testing.assert_close(got, oracle.run(hidden)[-1], atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("query", ["last", "actions"])
@pytest.mark.parametrize("r", [0.25, 0.75])
def test_bidirectional_pass_equals_masking_the_dropped_tokens(decoder, r, query):
    FastV(FastVConfig(k=2, r=r, query=query)).apply(decoder)
    oracle = Oracle(decoder, 2, r, False, ROWS if query == "actions" else (LENGTH - 1, LENGTH))
    expected = oracle.run(_hidden())[oracle.whole(LENGTH)]
    got = decoder(_hidden(), causal=False, rows=ROWS)[0]
    torch.testing.assert_close(got, expected, atol=TOLERANCE, rtol=0)
    assert decoder.visual_kept == round(VISUAL * (1 - r))


@pytest.mark.parametrize("causal", [True, False])
def test_dropping_nothing_is_bit_identical_to_no_preset(decoder, causal):
    plain = decoder(_hidden(), causal=causal, rows=ROWS)
    FastV(FastVConfig(r=0.0)).apply(decoder)
    assert torch.equal(decoder(_hidden(), causal=causal, rows=ROWS), plain)
    assert decoder.visual_kept == VISUAL


def test_dropping_tokens_changes_the_result(decoder):
    plain = decoder(_hidden(), causal=True)[0, -1]
    FastV(FastVConfig(r=0.5)).apply(decoder)
    assert (decoder(_hidden(), causal=True)[0, -1] - plain).abs().max() > 1e-3


def test_a_layer_the_decoder_lacks_is_refused_with_the_range(decoder):
    with pytest.raises(ConfigurationError, match=r"layer 5.*has 5 layers.*between 1 and 4"):
        FastV(FastVConfig(k=5, r=0.5)).apply(decoder)


def test_action_rows_as_query_are_refused_for_token_decoding(decoder):
    FastV(FastVConfig(r=0.5, query="actions")).apply(decoder)
    with pytest.raises(ConfigurationError, match="OpenVLA-OFT"):
        decoder(_hidden(), causal=True)
