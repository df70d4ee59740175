"""The decoder: a Llama-shaped language model with fused projections and a static key-value cache."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.pruning import AttentionView, TokenSelection
from roboneuron.contract.decoding import DecoderShape
from roboneuron.errors import ConfigurationError


class DecoderLayer(nn.Module):
    """One layer. Source: Touvron et al. 2023 (pre-norm, rotary positions, gated SiLU)."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.heads, self.key_value_heads, self.head_width = shape.heads, shape.key_value_heads, shape.head_width
        self.epsilon = shape.norm_epsilon
        rows = (shape.heads + 2 * shape.key_value_heads) * shape.head_width
        self.norm_in = nn.Parameter(torch.empty(shape.hidden))
        self.qkv = nn.Parameter(torch.empty(rows, shape.hidden))
        self.out = nn.Parameter(torch.empty(shape.hidden, shape.heads * shape.head_width))
        self.norm_post = nn.Parameter(torch.empty(shape.hidden))
        self.gate_up = nn.Parameter(torch.empty(2 * shape.intermediate, shape.hidden))
        self.down = nn.Parameter(torch.empty(shape.hidden, shape.intermediate))

    def project(self, hidden: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hidden (1, n, hidden) -> query (1, heads, n, width), key and value (1, key-value heads, n, width)."""
        normed = functional.rms_norm(hidden, self.norm_in.shape, self.norm_in, self.epsilon)
        packed = functional.linear(normed, self.qkv)
        packed = packed.view(1, hidden.shape[1], -1, self.head_width).transpose(1, 2)
        rotated, value = torch.split(packed, [self.heads + self.key_value_heads, self.key_value_heads], dim=1)
        first, second = rotated.chunk(2, dim=-1)
        rotated = rotated * cos + torch.cat((-second, first), dim=-1) * sin
        query, key = torch.split(rotated, [self.heads, self.key_value_heads], dim=1)
        return query, key, value

    def attend(self, query: Tensor, key: Tensor, value: Tensor, causal: bool) -> Tensor:
        """Scaled dot-product attention -> (1, heads, n, width)."""
        return functional.scaled_dot_product_attention(
            query, key, value, is_causal=causal, enable_gqa=self.heads != self.key_value_heads
        )

    def merge(self, hidden: Tensor, attended: Tensor) -> Tensor:
        """Add attention and the gated layer to the residual stream (1, n, hidden)."""
        flat = attended.transpose(1, 2).reshape(1, hidden.shape[1], -1)
        hidden = hidden + functional.linear(flat, self.out)
        normed = functional.rms_norm(hidden, self.norm_post.shape, self.norm_post, self.epsilon)
        gate, up = functional.linear(normed, self.gate_up).chunk(2, dim=-1)
        return hidden + functional.linear(functional.silu(gate) * up, self.down)


class Decoder(nn.Module):
    """The whole language model; batch 1.

    `visual_kept` after a pass is the number of visual positions that reached the last layer.
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, shape: DecoderShape, visual_tokens: int) -> None:
        super().__init__()
        self.shape = shape
        self.visual_tokens = visual_tokens
        self.visual_kept = visual_tokens
        self._selection: TokenSelection | None = None
        self.embedding = nn.Parameter(torch.empty(shape.vocabulary, shape.hidden))
        self.layers = nn.ModuleList(DecoderLayer(shape) for _ in range(shape.layers))
        self.norm = nn.Parameter(torch.empty(shape.hidden))
        self.head = nn.Parameter(torch.empty(shape.vocabulary, shape.hidden))

    def prepare_positions(self, device: torch.device, dtype: torch.dtype) -> None:
        """Compute the rotary tables (positions, head width) in float32, keep them in `dtype`."""
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
        self._selection = selection

    def embed(self, ids: Tensor) -> Tensor:
        """Ids (...) -> embeddings (..., hidden)."""
        return functional.embedding(ids, self.embedding)

    def forward(
        self,
        hidden: Tensor,
        *,
        causal: bool,
        cache: KeyValueCache | None = None,
        rows: tuple[int, int] | None = None,
    ) -> Tensor:
        """Run all layers and the final norm on a whole sequence.

        Args:
            hidden: embeddings (1, n, hidden); visual tokens stand at positions 1 .. visual_tokens.
            causal: False lets every position see every other.
            cache: keys and values are kept there from its start when given.
            rows: positions read afterwards, for a selection that looks at them.

        Returns:
            (1, n', hidden): n' is less than n by the visual tokens that the installed selection dropped.
        """
        count = hidden.shape[1]
        cos, sin = self.cos[:count], self.sin[:count]
        view: AttentionView | None = None
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            if self._selection is not None and index == self._selection.layer and view is not None:
                keep = self._selection.select(view)
                if keep is not None:
                    hidden, cos, sin = hidden[:, keep], cos[keep], sin[keep]
            query, key, value = layer.project(hidden, cos, sin)
            if cache is not None:
                cache.start(index, key, value)
            hidden = layer.merge(hidden, layer.attend(query, key, value, causal))
            if self._selection is not None and index + 1 == self._selection.layer:
                view = AttentionView(
                    query=query, key=key, visual_start=1, visual_count=self.visual_tokens, rows=rows, causal=causal
                )
        self.visual_kept = self.visual_tokens - (count - hidden.shape[1])
        return functional.rms_norm(hidden, self.norm.shape, self.norm, self.shape.norm_epsilon)

    def step(self, hidden: Tensor, position: int, cache: KeyValueCache) -> Tensor:
        """Run one more token (1, 1, hidden) at `position` of the unpruned sequence; grows the cache by one."""
        cos, sin = self.cos[position : position + 1], self.sin[position : position + 1]
        for index, layer in enumerate(self.layers):
            assert isinstance(layer, DecoderLayer)
            query, key, value = layer.project(hidden, cos, sin)
            keys, values = cache.append(index, key, value)
            hidden = layer.merge(hidden, layer.attend(query, keys, values, False))
        return functional.rms_norm(hidden, self.norm.shape, self.norm, self.shape.norm_epsilon)

    def logits(self, hidden: Tensor) -> Tensor:
        """Hidden (..., hidden) after the final norm -> float32 (..., vocabulary)."""
        return functional.linear(hidden, self.head).float()

    def slots(self) -> Mapping[str, Tensor]:
        """Where each tensor of the Hugging Face Llama layout goes: views on the fused parameters, by its name."""
        slots: dict[str, Tensor] = {
            "model.embed_tokens.weight": self.embedding.data,
            "model.norm.weight": self.norm.data,
            "lm_head.weight": self.head.data,
        }
        wide, narrow = (count * self.shape.head_width for count in (self.shape.heads, self.shape.key_value_heads))
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
