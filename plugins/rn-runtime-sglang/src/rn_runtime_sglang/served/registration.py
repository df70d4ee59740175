"""Entry point of the group `sglang.srt.plugins`: SGLang calls `register` early in each of its
processes.
"""

from __future__ import annotations


def register() -> None:
    """Register the model type `openvla`; code in a checkpoint's directory is never run for it."""
    # heavy
    from sglang.srt.multimodal.customized_mm_processor_utils import register_customized_processor
    from transformers import AutoConfig

    from rn_runtime_sglang.served.configuration import MODEL_TYPE, OpenVlaFiles, OpenVlaServedConfig

    AutoConfig.register(MODEL_TYPE, OpenVlaServedConfig, exist_ok=True)
    register_customized_processor(OpenVlaFiles)(OpenVlaServedConfig)
