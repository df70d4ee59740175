"""OpenVLA for SGLang: the backend package's vision part in front of SGLang's own Llama."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch
from sglang.srt.managers.mm_utils import (
    MultiModalityDataPaddingPatternMultimodalTokens,
    general_mm_embed_routine,
)
from sglang.srt.managers.schedule_batch import Modality, MultimodalDataItem, MultimodalInputs
from sglang.srt.models.llama import LlamaForCausalLM
from torch import Tensor, nn

from rn_runtime_sglang.served.configuration import OpenVlaServedConfig
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.front import OpenVlaFront

UNUSABLE_TOKEN = 0
"""Token (the id of <unk>) for non-finite logits; the runtime refuses a reply that contains it."""


class OpenVLAForActionPrediction(nn.Module):
    """Named as in checkpoints, because SGLang finds it by this name."""

    def __init__(
        self, config: OpenVlaServedConfig, quant_config: object = None, prefix: str = ""
    ) -> None:
        super().__init__()
        self.config = config
        checkpoint = OpenvlaCheckpoint.read(Path(config._name_or_path))
        self._weights = {
            name: weight for shard in checkpoint.shards for name, weight in shard.weights.items()
        }
        self.front = OpenVlaFront(checkpoint.vision)
        self.language_model = LlamaForCausalLM(
            config.text_config, quant_config, prefix="language_model"
        )

    def get_input_embeddings(self) -> nn.Module:
        """The word embedding, for SGLang."""
        embedding: nn.Module = self.language_model.get_input_embeddings()
        return embedding

    def pad_input_ids(self, input_ids: object, mm_inputs: MultimodalInputs) -> object:
        """Mark the image positions with the image's hash, which keys the prefix cache."""
        return MultiModalityDataPaddingPatternMultimodalTokens().pad_input_tokens(
            input_ids, mm_inputs
        )

    def get_image_feature(self, items: list[MultimodalDataItem]) -> Tensor:
        """Embed the pixels of each item (1, channels, side, side) as patches (items * patches,
        hidden).
        """
        parameter = next(self.front.parameters())
        pixels = torch.cat([item.feature for item in items]).to(parameter.device, parameter.dtype)
        return self.front.patches(pixels)[0]

    @torch.no_grad()
    def forward(
        self, input_ids: Tensor, positions: Tensor, forward_batch: object, **others: object
    ) -> object:
        """One prefill or decode step of a batch."""
        output = general_mm_embed_routine(
            input_ids=input_ids,
            forward_batch=forward_batch,
            language_model=self.language_model,
            data_embedding_funcs={Modality.IMAGE: self.get_image_feature},
            positions=positions,
        )
        logits = getattr(output, "next_token_logits", None)
        if logits is not None:
            # On the device and without synchronisation: an argmax over NaN would look like an
            # action.
            unusable = ~torch.isfinite(logits).all(dim=-1, keepdim=True)
            logits.masked_fill_(unusable, 0.0)
            logits[:, UNUSABLE_TOKEN : UNUSABLE_TOKEN + 1].masked_fill_(unusable, 1.0)
        return output

    def load_weights(self, weights: Iterable[tuple[str, Tensor]]) -> None:
        """Load every tensor of the checkpoint to its place in the backend's table.

        Raises:
            ValueError: a tensor is missing, unknown, of another shape, of integers, or not finite.
        """
        slots = dict(self.front.named_parameters())
        missing = set(self._weights)
        decoder: list[tuple[str, Tensor]] = []
        for name, tensor in weights:
            expected = self._weights.get(name)
            if expected is None or tuple(tensor.shape) != expected.shape:
                wanted = "no such tensor" if expected is None else f"shape {expected.shape}"
                raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {wanted}")
            if not tensor.is_floating_point():
                raise ValueError(f"{name} has the number type {tensor.dtype}, which no weight has")
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{name} holds NaN or infinite values")
            missing.discard(name)
            part, _, target = expected.target.partition(".")
            if part == "front":
                slots[target].data.copy_(tensor)
            elif part == "decoder":
                decoder.append((target, tensor))
        if missing:
            raise ValueError(
                f"{len(missing)} tensors are missing: {', '.join(sorted(missing)[:8])}"
            )
        self.language_model.load_weights(decoder)


EntryClass = OpenVLAForActionPrediction
