"""Conversion of a request's image and token ids to the model's input, with the backend package's
own preprocessing.
"""

from __future__ import annotations

import base64
import binascii
import io
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from sglang.srt.managers.schedule_batch import (
    Modality,
    MultimodalDataItem,
    MultimodalProcessorOutput,
)
from sglang.srt.multimodal.processors.base_processor import BaseMultimodalProcessor
from transformers import PretrainedConfig

from rn_runtime_sglang.served.models.openvla import OpenVLAForActionPrediction
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import BOS_ID, FINAL_ID

FORMATS = ("PNG", "BMP")
"""Lossless and fast formats; a lossy image would give other tokens than in process."""


class OpenVlaProcessor(BaseMultimodalProcessor):  # type: ignore[misc, unused-ignore]
    """Processor for one image in the request itself, and the prompt as token ids."""

    models = (OpenVLAForActionPrediction,)

    def __init__(
        self,
        hf_config: PretrainedConfig,
        server_args: object,
        processor: object,
        transport_mode: object,
        **others: object,
    ) -> None:
        super().__init__(hf_config, server_args, processor, transport_mode, **others)
        checkpoint = OpenvlaCheckpoint.read(Path(hf_config._name_or_path))
        tower = checkpoint.vision.towers[0]
        self._preprocessor = Preprocessor(size=tower.image, towers=checkpoint.towers)
        self._patches = tower.patches
        self._embeddings = checkpoint.decoder.vocabulary
        self._image_token = checkpoint.token_vocabulary  # <PAD>, which no prompt holds

    async def process_mm_data_async(
        self,
        image_data: object,
        audio_data: object = None,
        input_text: object = None,
        request_obj: object = None,
        **others: object,
    ) -> MultimodalProcessorOutput:
        """The prompt with placeholders of the patches after its first id, and the pixels.

        Raises:
            ValueError: answered as status 400 with the text.
        """
        ids = check_ids(input_text, self._embeddings)
        if not isinstance(image_data, list) or len(image_data) != 1:
            raise ValueError("exactly one image is needed")
        pixels = self._preprocessor.to_pixels(decode_image(image_data[0]))
        return MultimodalProcessorOutput(
            input_ids=[ids[0], *[self._image_token] * self._patches, *ids[1:]],
            im_token_id=self._image_token,
            mm_items=[
                MultimodalDataItem(
                    modality=Modality.IMAGE,
                    feature=torch.from_numpy(pixels)[None],
                    offsets=[(1, self._patches)],
                )
            ],
        )


def check_ids(ids: object, embeddings: int) -> list[int]:
    """Return the prompt's ids; raises ValueError unless they begin and end as in training.

    An id without an embedding would corrupt the GPU's context, and so crash the server.
    """
    if not isinstance(ids, list) or not all(type(value) is int for value in ids):
        raise ValueError("the prompt must be token ids (`input_ids`), not text")
    if len(ids) < 2 or ids[0] != BOS_ID or ids[-1] != FINAL_ID:
        raise ValueError(
            f"the prompt's ids are {ids[:2]} ... {ids[-1:]}, expected [{BOS_ID} ... {FINAL_ID}]"
        )
    if min(ids) < 0 or max(ids) >= embeddings:
        raise ValueError(
            f"the prompt's ids are {min(ids)} to {max(ids)}, the model has {embeddings} embeddings"
        )
    return ids


def decode_image(data: object) -> NDArray[np.uint8]:
    """Decode base64 of a PNG or BMP to uint8 (H, W, 3) RGB. URLs and file names are never
    followed.
    """
    text = getattr(data, "url", data)
    if not isinstance(text, str):
        raise ValueError(f"the image is a {type(text).__name__}, expected base64 text")
    try:
        raw = base64.b64decode(text.rpartition(",")[2], validate=True)
        image = Image.open(io.BytesIO(raw), formats=FORMATS)
        return np.asarray(image.convert("RGB"))
    except (binascii.Error, OSError) as error:
        raise ValueError(
            f"the image is not base64 of a {' or '.join(FORMATS)} picture: {error}"
        ) from error
