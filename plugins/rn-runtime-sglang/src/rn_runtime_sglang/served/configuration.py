"""The configuration and tokenizer classes that SGLang requests from transformers, created from the
public checkpoint files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from transformers import LlamaConfig, PretrainedConfig, PreTrainedTokenizerFast

from rn_vla.openvla.model_files import TextConfig

MODEL_TYPE = "openvla"
ARCHITECTURE = "OpenVLAForActionPrediction"


class OpenVlaServedConfig(PretrainedConfig):  # type: ignore[misc, no-untyped-call, unused-ignore]
    """config.json of an OpenVLA checkpoint; the decoder's part is completed with the defaults of
    its release.
    """

    model_type = MODEL_TYPE

    def __init__(
        self, text_config: dict[str, Any] | LlamaConfig | None = None, **others: Any
    ) -> None:
        self.text_config = (
            text_config if isinstance(text_config, LlamaConfig) else _llama(text_config or {})
        )
        others.pop("auto_map", None)  # names code in the checkpoint's directory, which is never run
        super().__init__(**others)
        self.architectures = [ARCHITECTURE]


def _llama(raw: dict[str, object]) -> LlamaConfig:
    text = TextConfig.model_validate(raw)
    return LlamaConfig(
        hidden_size=text.hidden_size,
        intermediate_size=text.intermediate_size,
        num_hidden_layers=text.num_hidden_layers,
        num_attention_heads=text.num_attention_heads,
        num_key_value_heads=text.num_key_value_heads or text.num_attention_heads,
        vocab_size=text.vocab_size,
        rms_norm_eps=text.rms_norm_eps,
        rope_parameters={"rope_type": "default", "rope_theta": text.rope_theta},
        max_position_embeddings=text.max_position_embeddings,
        tie_word_embeddings=text.tie_word_embeddings,
    )


class OpenVlaTokenizer(PreTrainedTokenizerFast):  # type: ignore[misc, unused-ignore]
    """tokenizer.json unchanged. SGLang requires a tokenizer, but never uses it, because requests
    contain token ids.
    """


class OpenVlaFiles:
    """Replaces the Hugging Face processor that SGLang expects."""

    def __init__(self, tokenizer: OpenVlaTokenizer) -> None:
        self.tokenizer = tokenizer

    @classmethod
    def from_pretrained(cls, name: str, *arguments: object, **options: object) -> OpenVlaFiles:
        """Read tokenizer.json of the checkpoint directory `name`; the other arguments are for other
        formats.
        """
        tokenizer = OpenVlaTokenizer(  # type: ignore[no-untyped-call, unused-ignore]
            tokenizer_file=str(Path(name) / "tokenizer.json"),
            bos_token="<s>",
            eos_token="</s>",
            unk_token="<unk>",
        )
        tokenizer.chat_template = ""
        return cls(tokenizer)
