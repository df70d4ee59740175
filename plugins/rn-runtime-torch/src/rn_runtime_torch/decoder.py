"""The decoder: a Llama-shaped language model with fused projections and a static key-value
cache.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.fillings import Fillings
from rn_runtime_torch.int8 import Int8Weight
from rn_runtime_torch.scratch import Scratch
from rn_vla.decoding import DecoderShape
from rn_vla.pruning import AttentionView, TokenSelection
from roboneuron import ConfigurationError, PluginError

MATRICES = ("qkv", "out", "gate_up", "down")
"""Weight matrices of a layer."""


class DecoderLayer(nn.Module):
    """One layer. Source: Touvron et al. 2023 (pre-norm, rotary positions, gated SiLU)."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.heads, self.key_value_heads, self.head_width = (
            shape.heads,
            shape.key_value_heads,
            shape.head_width,
        )
        self.epsilon = shape.norm_epsilon
        rows = (shape.heads + 2 * shape.key_value_heads) * shape.head_width
        self.norm_in = nn.Parameter(torch.empty(shape.hidden))
        self.qkv = nn.Parameter(torch.empty(rows, shape.hidden))
        self.out = nn.Parameter(torch.empty(shape.hidden, shape.heads * shape.head_width))
        self.norm_post = nn.Parameter(torch.empty(shape.hidden))
        self.gate_up = nn.Parameter(torch.empty(2 * shape.intermediate, shape.hidden))
        self.down = nn.Parameter(torch.empty(shape.hidden, shape.intermediate))
        self.int8: dict[str, Int8Weight] = {}

    def quantize(self) -> None:
        """Create int8 copies of the matrices, which later decoding steps use."""
        self.int8 = {name: Int8Weight(getattr(self, name)) for name in MATRICES}

    def project(
        self, hidden: Tensor, cos: Tensor, sin: Tensor, scratch: Scratch, stepping: bool = False
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Project hidden (b, n, hidden) to query (b, heads, n, width), key and value (b, key-value
        heads, n, width).

        `cos` and `sin` are (n, width) or (b, 1, n, width); `stepping` is True for the single row of
        a decoded token. Query and key of one sequence are contiguous: attention on the CPU loses up
        to a quarter of its speed to other layouts.
        """
        batch, count, width = *hidden.shape[:2], self.head_width
        normed = functional.rms_norm(hidden, self.norm_in.shape, self.norm_in, self.epsilon)
        flat = self._times(normed.flatten(0, 1), "qkv", scratch, stepping)
        packed = flat.view(batch, count, -1, width).transpose(1, 2)
        turned, value = torch.split(
            packed, [self.heads + self.key_value_heads, self.key_value_heads], dim=1
        )
        rotated = scratch.empty(
            "rotated", hidden, batch, self.heads + self.key_value_heads, count, width
        )
        rotate(turned, cos, sin, rotated)
        query, key = torch.split(rotated, [self.heads, self.key_value_heads], dim=1)
        return query, key, value

    def attend(
        self, query: Tensor, key: Tensor, value: Tensor, causal: bool, seen: Tensor | None = None
    ) -> Tensor:
        """Scaled dot-product attention (b, heads, n, width), restricted to the positions `seen` (b,
        1, 1, n).
        """
        return functional.scaled_dot_product_attention(
            query,
            key,
            value,
            attn_mask=seen,
            is_causal=causal,
            enable_gqa=self.heads != self.key_value_heads,
        )

    def merge(
        self, hidden: Tensor, attended: Tensor, scratch: Scratch, stepping: bool = False
    ) -> Tensor:
        """Add attention and the gated layer to the residual stream (b, n, hidden), contiguous, in
        place.
        """
        stream = hidden.view(-1, hidden.shape[-1])
        self._add(stream, attended.transpose(1, 2).reshape(stream.shape[0], -1), "out", stepping)
        normed = functional.rms_norm(hidden, self.norm_post.shape, self.norm_post, self.epsilon)
        gate, up = self._times(normed.flatten(0, 1), "gate_up", scratch, stepping).chunk(2, dim=-1)
        self._add(stream, functional.silu(gate, inplace=True).mul_(up), "down", stepping)
        return hidden

    def _times(self, rows: Tensor, name: str, scratch: Scratch, stepping: bool) -> Tensor:
        """Multiply rows (n, inputs) by a matrix; returns (n, outputs)."""
        if self.int8 and stepping:
            return self.int8[name].times(rows)
        weight: Tensor = getattr(self, name)
        return torch.mm(
            rows, weight.t(), out=scratch.empty(name, rows, rows.shape[0], weight.shape[0])
        )

    def _add(self, to: Tensor, rows: Tensor, name: str, stepping: bool) -> None:
        """Multiply rows (n, inputs) by a matrix, and add them to (n, outputs)."""
        if self.int8 and stepping:
            to.add_(self.int8[name].times(rows))
        else:
            to.addmm_(rows, getattr(self, name).t())


def rotate(heads: Tensor, cos: Tensor, sin: Tensor, out: Tensor) -> None:
    """Apply rotary positions to (b, heads, n, width), halves paired, and write `out`: one read of
    each half, no temporaries.

    Source: Su et al. 2021, in the layout of the Hugging Face Llama.
    """
    half = heads.shape[-1] // 2
    cos, sin = cos[..., :half], sin[..., :half]
    first, second = torch.split(heads, half, dim=-1)
    out_first, out_second = torch.split(out, half, dim=-1)
    # is fused by the compiler, which does not support `out` as a part of a tensor
    if torch.compiler.is_compiling():
        out.copy_(torch.cat((first * cos - second * sin, second * cos + first * sin), dim=-1))
        return
    torch.mul(first, cos, out=out_first).addcmul_(second, sin, value=-1)
    torch.mul(second, cos, out=out_second).addcmul_(first, sin)


class Decoder(nn.Module):
    """The whole language model.

    Attributes:
        visual_kept: after a pass, the number of visual positions that reached the last layer.
        selection: selects the visual positions to keep; None keeps all.
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, shape: DecoderShape, visual_tokens: int) -> None:
        super().__init__()
        self.shape = shape
        self.visual_tokens = visual_tokens
        self.visual_kept = visual_tokens
        self.scratch = Scratch()
        self.selection: TokenSelection | None = None
        self.embedding = nn.Parameter(torch.empty(shape.vocabulary, shape.hidden))
        self.layers = nn.ModuleList(DecoderLayer(shape) for _ in range(shape.layers))
        self.norm = nn.Parameter(torch.empty(shape.hidden))
        self.head = nn.Parameter(torch.empty(shape.vocabulary, shape.hidden))

    def prepare_positions(self, device: torch.device, dtype: torch.dtype) -> None:
        """Compute the rotary tables (positions, head width) in float32, and store them in
        `dtype`.
        """
        width = self.shape.head_width
        powers = torch.arange(0, width, 2, dtype=torch.float32, device=device) / width
        steps = torch.arange(self.shape.max_positions, dtype=torch.float32, device=device)
        angles = torch.outer(steps, 1.0 / self.shape.rope_theta**powers).repeat(1, 2)
        self.register_buffer("cos", angles.cos().to(dtype), persistent=False)
        self.register_buffer("sin", angles.sin().to(dtype), persistent=False)

    def install_selection(self, selection: TokenSelection) -> None:
        """See `PrunableDecoder`."""
        if not 1 <= selection.layer < self.shape.layers:
            raise ConfigurationError(
                f"Visual tokens cannot be dropped before layer {selection.layer}: this decoder has "
                f"{self.shape.layers} layers.",
                hint=f"Choose k between 1 and {self.shape.layers - 1}.",
            )
        self.selection = selection

    def try_selection(
        self, positions: int, *, causal: bool, rows: tuple[int, int] | None = None
    ) -> None:
        """Call the selection once, with zero attention in a sequence of `positions` positions.

        Raises:
            PluginError: its answer is invalid.
            RoboNeuronError: the selection's own error.
        """
        if self.selection is None:
            return
        shape = self.shape
        key = self.cos.new_zeros(1, shape.key_value_heads, positions, shape.head_width)
        view = AttentionView(
            query=self.cos.new_zeros(1, shape.heads, positions, shape.head_width),
            key=key,
            visual_start=1,
            visual_count=self.visual_tokens,
            rows=rows,
            causal=causal,
        )
        kept = self.selection.select(view)
        if kept is None:
            return
        told, words = kept.tolist(), {0, *range(1 + self.visual_tokens, positions)}
        if told != sorted(set(told)) or not words <= set(told) <= set(range(positions)):
            raise PluginError(
                f"{type(self.selection).__name__} kept {len(told)} of {positions} positions, "
                "expected ascending ones "
                "and every one that holds no image patch."
            )

    def quantize(self) -> None:
        """Decode with int8 copies of the layers' matrices from now on; prompts still use the
        original matrices.
        """
        for layer in self.layers:
            assert isinstance(layer, DecoderLayer)
            layer.quantize()

    def embed(self, ids: Tensor) -> Tensor:
        """Embed ids (...) as (..., hidden)."""
        return functional.embedding(ids, self.embedding)

    def forward(
        self,
        hidden: Tensor,
        *,
        causal: bool,
        cache: KeyValueCache | None = None,
        rows: tuple[int, int] | None = None,
        last: int | None = None,
        fillings: Fillings | None = None,
    ) -> Tensor:
        """Run all layers and the final norm on a whole sequence, or on several without a causal
        mask.

        Args:
            hidden: embeddings (b, n, hidden); visual tokens are at positions 1 .. visual_tokens.
            causal: False lets every position attend to all others.
            cache: if given, keys and values are stored there from its start.
            rows: positions read afterwards, for a selection that uses them.
            last: number of positions at the end that are read afterwards; the last layer computes
                only these. None for all.
            fillings: padding positions of several sequences; None for a single sequence.

        Returns:
            (b, last, hidden), or (b, n', hidden): n' is less than n by the visual tokens that the
            selection dropped.
        """
        count, scratch = hidden.shape[1], self.scratch
        cos, sin, seen = self.cos[:count], self.sin[:count], None
        if fillings is not None:
            cos, sin, seen = fillings.tables(self.cos, self.sin, count)
        # layers add to it in place
        hidden = scratch.empty("hidden", hidden, *hidden.shape).copy_(hidden)
        view: AttentionView | None = None
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            if self.selection is not None and index == self.selection.layer and view is not None:
                if fillings is not None:
                    hidden, cos, sin, seen = fillings.prune(
                        self.selection, view, (hidden, cos, sin, seen)
                    )
                elif (keep := self.selection.select(view)) is not None:
                    hidden, cos, sin = hidden[:, keep], cos[keep], sin[keep]
            query, key, value = layer.project(hidden, cos, sin, scratch)
            if cache is not None:
                key, value = cache.start(index, key, value)
            elif value.device.type == "cpu":
                # contiguous, as in `project`
                value = scratch.empty("value", value, *value.shape).copy_(value)
            if self.selection is not None and index + 1 == self.selection.layer:
                view = AttentionView(
                    query=query,
                    key=key,
                    visual_start=1,
                    visual_count=self.visual_tokens,
                    rows=rows,
                    causal=causal,
                )
            if last is not None and index + 1 == len(self.layers):
                self.visual_kept = self.visual_tokens - (count - hidden.shape[1])
                attended = self._attend_last(layer, query, key, value, causal, last, seen)
                hidden = layer.merge(hidden[:, -last:].clone(), attended, scratch)
            else:
                hidden = layer.merge(hidden, layer.attend(query, key, value, causal, seen), scratch)
        if last is None:
            self.visual_kept = self.visual_tokens - (count - hidden.shape[1])
        return functional.rms_norm(hidden, self.norm.shape, self.norm, self.shape.norm_epsilon)

    @staticmethod
    def _attend_last(
        layer: DecoderLayer,
        query: Tensor,
        key: Tensor,
        value: Tensor,
        causal: bool,
        last: int,
        seen: Tensor | None,
    ) -> Tensor:
        """Attention of the last positions; the very last one attends to all, causal or not."""
        if causal and last > 1:
            return layer.attend(query, key, value, causal)[:, :, -last:]
        return layer.attend(query[:, :, -last:], key, value, False, seen)

    def step(self, hidden: Tensor, position: int, cache: KeyValueCache) -> Tensor:
        """Run one more token (1, 1, hidden) at `position` of the unpruned sequence; extends the
        cache by one.

        `hidden` is overwritten.
        """
        cos, sin = self.cos[position : position + 1], self.sin[position : position + 1]
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            query, key, value = layer.project(hidden, cos, sin, self.scratch, stepping=True)
            keys, values = cache.append(index, key, value)
            hidden = layer.merge(
                hidden, layer.attend(query, keys, values, False), self.scratch, stepping=True
            )
        return functional.rms_norm(hidden, self.norm.shape, self.norm, self.shape.norm_epsilon)

    def logits(self, hidden: Tensor) -> Tensor:
        """Logits float32 (b, n, vocabulary) of hidden (b, n, hidden) after the final norm."""
        # Rows as a plain matrix: for a three-dimensional slice torch copies the whole weight for a
        # batched product.
        return torch.mm(hidden.flatten(0, 1), self.head.t()).view(*hidden.shape[:2], -1).float()

    def slots(self) -> Mapping[str, Tensor]:
        """Destination of each tensor of the Hugging Face Llama layout: views of the fused
        parameters, by name.
        """
        slots: dict[str, Tensor] = {
            "model.embed_tokens.weight": self.embedding.data,
            "model.norm.weight": self.norm.data,
            "lm_head.weight": self.head.data,
        }
        wide, narrow = (
            count * self.shape.head_width
            for count in (self.shape.heads, self.shape.key_value_heads)
        )
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            base = f"model.layers.{index}."
            query, key, value = torch.split(layer.qkv.data, [wide, narrow, narrow])
            gate, up = layer.gate_up.data.chunk(2)
            slots |= {
                f"{base}self_attn.q_proj.weight": query,
                f"{base}self_attn.k_proj.weight": key,
                f"{base}self_attn.v_proj.weight": value,
                f"{base}self_attn.o_proj.weight": layer.out.data,
                f"{base}mlp.gate_proj.weight": gate,
                f"{base}mlp.up_proj.weight": up,
                f"{base}mlp.down_proj.weight": layer.down.data,
                f"{base}input_layernorm.weight": layer.norm_in.data,
                f"{base}post_attention_layernorm.weight": layer.norm_post.data,
            }
        return MappingProxyType(slots)
