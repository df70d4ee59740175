"""Dimensions of a pi0, pi0.5 or pi0-FAST model and the tensors that a checkpoint of these
dimensions must hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from roboneuron import CheckpointError

Variant = Literal["pi0", "pi05", "pi0_fast"]
"""Model variant; the public names are pi0, pi0.5 and pi0-FAST."""
_PALIGEMMA = "paligemma_with_expert.paligemma."
_VISION = _PALIGEMMA + "model.vision_tower.vision_model."
_PREFIX = _PALIGEMMA + "model.language_model."
_EXPERT = "paligemma_with_expert.gemma_expert."
EMBEDDING_KEYS = (_PALIGEMMA + "lm_head.weight", _PREFIX + "embed_tokens.weight")
"""The token embedding is tied to the head: a checkpoint holds it under one or both of these
names.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class GemmaDims:
    """One Gemma decoder stack."""

    width: int
    depth: int
    mlp: int
    heads: int
    kv_heads: int
    head_dim: int
    norm_eps: float = 1e-6
    rope_base: float = 10_000.0


@dataclass(frozen=True, kw_only=True, slots=True)
class VisionDims:
    """The SigLIP vision tower."""

    width: int
    depth: int
    mlp: int
    heads: int
    patch: int = 14
    image: int = 224
    norm_eps: float = 1e-6

    @property
    def tokens(self) -> int:
        """Tokens of one image."""
        return (self.image // self.patch) ** 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Pi0Dims:
    """A whole pi0 model.

    Attributes:
        vision, prefix, expert: the three stacks; prefix and expert share heads and depth.
        vocabulary: rows of the token embedding.
        variant: "pi0" has a token for the state; "pi05" has it in the prompt, and adaptive norms in
            the expert; "pi0_fast" has it in the prompt and no expert.
        chunk: actions per inference.
        state, action: padded widths of the state and of one action.
        min_period, max_period: range of the sine-cosine embedding of the flow time.
    """

    vision: VisionDims
    prefix: GemmaDims
    expert: GemmaDims
    vocabulary: int
    variant: Variant = "pi0"
    chunk: int = 50
    state: int = 32
    action: int = 32
    min_period: float = 4e-3
    max_period: float = 4.0

    def __post_init__(self) -> None:
        a, b = self.prefix, self.expert
        if (a.depth, a.heads, a.kv_heads, a.head_dim) != (b.depth, b.heads, b.kv_heads, b.head_dim):
            raise CheckpointError(
                "The language model and the action expert share keys and values, so their depth, "
                "heads and head size "
                f"must be equal; got {a} and {b}. Check vlm_config and dit_config in config.json."
            )
        if self.vision.image % self.vision.patch or self.expert.width % 2 or a.heads % a.kv_heads:
            raise CheckpointError(
                f"Model dimensions do not divide: image {self.vision.image} by patch "
                f"{self.vision.patch}, expert width "
                f"{self.expert.width} by 2, heads {a.heads} by key heads {a.kv_heads}. Check "
                "config.json."
            )


SO400M = VisionDims(width=1152, depth=27, mlp=4304, heads=16)
"""SigLIP So400m/14 at 224 px. Source: openpi and LeRobot fix it for every released pi0."""
GEMMA_VARIANTS = {
    "gemma_2b": GemmaDims(width=2048, depth=18, mlp=16_384, heads=8, kv_heads=1, head_dim=256),
    "gemma_300m": GemmaDims(width=1024, depth=18, mlp=4096, heads=8, kv_heads=1, head_dim=256),
    "dummy": GemmaDims(width=64, depth=4, mlp=128, heads=8, kv_heads=1, head_dim=16),
}
"""Gemma sizes by the names that config.json uses. Source: openpi, models/gemma.py."""
PALIGEMMA_VOCABULARY = 257_152

Shape = tuple[int, ...]


def _linear(name: str, rows: int, columns: int, *, bias: bool = True) -> dict[str, Shape]:
    shapes: dict[str, Shape] = {f"{name}.weight": (rows, columns)}
    if bias:
        shapes[f"{name}.bias"] = (rows,)
    return shapes


def _norm(name: str, width: int) -> dict[str, Shape]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def _vision(dims: VisionDims) -> dict[str, Shape]:
    embeddings = _VISION + "embeddings."
    shapes: dict[str, Shape] = {
        embeddings + "patch_embedding.weight": (dims.width, 3, dims.patch, dims.patch),
        embeddings + "patch_embedding.bias": (dims.width,),
        embeddings + "position_embedding.weight": (dims.tokens, dims.width),
    }
    for index in range(dims.depth):
        layer = f"{_VISION}encoder.layers.{index}."
        for part in ("q_proj", "k_proj", "v_proj", "out_proj"):
            shapes |= _linear(f"{layer}self_attn.{part}", dims.width, dims.width)
        shapes |= _linear(layer + "mlp.fc1", dims.mlp, dims.width) | _linear(
            layer + "mlp.fc2", dims.width, dims.mlp
        )
        shapes |= _norm(layer + "layer_norm1", dims.width) | _norm(
            layer + "layer_norm2", dims.width
        )
    return shapes | _norm(_VISION + "post_layernorm", dims.width)


def _rms_norm(name: str, width: int, *, adaptive: bool) -> dict[str, Shape]:
    return _linear(f"{name}.dense", 3 * width, width) if adaptive else {f"{name}.weight": (width,)}


def _gemma(prefix: str, dims: GemmaDims, *, adaptive: bool = False) -> dict[str, Shape]:
    shapes = _rms_norm(prefix + "norm", dims.width, adaptive=adaptive)
    queries, keys = dims.heads * dims.head_dim, dims.kv_heads * dims.head_dim
    for index in range(dims.depth):
        layer = f"{prefix}layers.{index}."
        shapes |= _linear(layer + "self_attn.q_proj", queries, dims.width, bias=False)
        shapes |= _linear(layer + "self_attn.k_proj", keys, dims.width, bias=False)
        shapes |= _linear(layer + "self_attn.v_proj", keys, dims.width, bias=False)
        shapes |= _linear(layer + "self_attn.o_proj", dims.width, queries, bias=False)
        shapes |= _linear(layer + "mlp.gate_proj", dims.mlp, dims.width, bias=False)
        shapes |= _linear(layer + "mlp.up_proj", dims.mlp, dims.width, bias=False)
        shapes |= _linear(layer + "mlp.down_proj", dims.width, dims.mlp, bias=False)
        shapes |= _rms_norm(layer + "input_layernorm", dims.width, adaptive=adaptive)
        shapes |= _rms_norm(layer + "post_attention_layernorm", dims.width, adaptive=adaptive)
    return shapes


def required_tensors(dims: Pi0Dims) -> dict[str, Shape]:
    """Shape by key (without LeRobot's leading "model.") of every tensor a checkpoint must hold.

    Without the token embedding, see EMBEDDING_KEYS. Source: the key lists of openpi's and LeRobot's
    PyTorch checkpoints.
    """
    common = {
        **_vision(dims.vision),
        **_linear(
            _PALIGEMMA + "model.multi_modal_projector.linear", dims.prefix.width, dims.vision.width
        ),
        **_gemma(_PREFIX, dims.prefix),
    }
    if dims.variant == "pi0_fast":
        return common
    width = dims.expert.width
    state: dict[str, Shape] = {}
    if dims.variant == "pi05":
        times = _linear("time_mlp_in", width, width) | _linear("time_mlp_out", width, width)
    else:
        state = _linear("state_proj", width, dims.state)
        times = _linear("action_time_mlp_in", width, 2 * width)
        times |= _linear("action_time_mlp_out", width, width)
    return {
        **common,
        **_gemma(_EXPERT + "model.", dims.expert, adaptive=dims.variant == "pi05"),
        **state,
        **_linear("action_in_proj", width, dims.action),
        **times,
        **_linear("action_out_proj", dims.action, width),
    }


def optional_tensors(dims: Pi0Dims) -> dict[str, Shape]:
    """Shape by key of tensors that a checkpoint may hold but inference never reads (the expert's
    head).
    """
    if dims.variant == "pi0_fast":
        return {}
    shape = (dims.vocabulary, dims.expert.width)
    return {_EXPERT + "lm_head.weight": shape, _EXPERT + "model.embed_tokens.weight": shape}


def module_keys(dims: Pi0Dims) -> dict[str, str]:
    """Checkpoint key by parameter name of the network, for all weights that inference reads.

    With an expert, the last layer of the language model only yields keys and values for it, so its
    other weights are left out.
    """
    last = f"{_PREFIX}layers.{dims.prefix.depth - 1}."
    last_used = ("input_layernorm.", "self_attn.k_proj.", "self_attn.v_proj.")
    names: dict[str, str] = {}
    for key in required_tensors(dims):
        unread = key == _PREFIX + "norm.weight" or (
            key.startswith(last) and not key[len(last) :].startswith(last_used)
        )
        if unread and dims.variant != "pi0_fast":
            continue
        names[_parameter_name(key)] = key
    return names


def _parameter_name(key: str) -> str:
    for old, new in (
        (_VISION + "embeddings.position_embedding.weight", "vision.position_embedding"),
        (_VISION + "embeddings.", "vision."),
        (_VISION + "encoder.", "vision."),
        (_VISION, "vision."),
        (_PALIGEMMA + "model.multi_modal_projector.linear", "projector"),
        (_PREFIX, "prefix."),
        (_EXPERT + "model.", "expert."),
    ):
        if key.startswith(old):
            return new + key[len(old) :]
    return key
