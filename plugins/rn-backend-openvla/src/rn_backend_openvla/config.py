"""Options of the OpenVLA backends."""

from __future__ import annotations

from typing import Literal

from rn_vla.openvla.options import OpenVlaModelOptions


class OpenVlaConfig(OpenVlaModelOptions):
    """Options of the backends `openvla` and `openvla-tcp`."""

    prompt: Literal["auto", "v02", "v01"] = "auto"
    """Prompt template; `auto` chooses by the checkpoint's language model (v01 was Vicuna)."""
