"""Zero-shot detectors from a folder in the public layouts: pictures and labels to boxes.

The library transformers does the reading, the processing and the network; this module checks what
it is given and what comes out. Sources: Minderer, Gritsenko and Houlsby, "Scaling open-vocabulary
object detection", NeurIPS 2023 (OWLv2); Liu et al., "Grounding DINO", ECCV 2024.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import transformers
from numpy.typing import NDArray

from roboneuron import (
    CheckpointError,
    ConfigurationError,
    ForeignDataError,
    InvalidInputError,
    foreign,
)

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_LIBRARY: Any = transformers
"""Most of it has no types."""
_CONFIG = "config.json"
_WEIGHTS = ("model.safetensors", "model.safetensors.index.json")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LabelBox:
    """What a detector found in a picture.

    Attributes:
        label: index of the label that fits best.
        score: 0..1.
        edges_px: float64 (4,), left, upper, right and lower edge [px]; may be outside the picture.
    """

    label: int
    score: float
    edges_px: F64


class Detector(ABC):
    """A loaded model with its processor; used from one thread."""

    model_type: ClassVar[str]
    model_class: ClassVar[str]

    def __init__(self, folder: Path, device: str) -> None:
        """Read a checkpoint; nothing is downloaded, and no code of it is run.

        Raises:
            CheckpointError: a file is missing or damaged, or weights are missing in it.
            ConfigurationError: there is no such device.
        """
        _LIBRARY.utils.logging.disable_progress_bar()
        kind = getattr(_LIBRARY, self.model_class)
        try:
            self.processor = _LIBRARY.AutoProcessor.from_pretrained(
                folder,
                local_files_only=True,
                trust_remote_code=False,
                # the other one needs torchvision
                backend="pil",
            )
            model, told = kind.from_pretrained(
                folder, local_files_only=True, use_safetensors=True, output_loading_info=True
            )
        except Exception as error:  # the border to the library, which raises anything
            raise CheckpointError(
                f"The checkpoint {folder} cannot be loaded: {_line_of(error)}"
            ) from error
        # without them the library goes on with random weights
        absent = sorted(map(str, [*told["missing_keys"], *told["mismatched_keys"]]))
        if absent:
            raise CheckpointError(
                f"The checkpoint {folder} lacks {len(absent)} weights, such as {absent[0][:120]}."
            )
        try:
            self.model = model.to(device).eval()
        except (RuntimeError, AssertionError) as error:
            raise ConfigurationError(
                f"The model cannot be put on {device!r}: {_line_of(error)}"
            ) from error
        self.device = device

    def boxes(
        self, picture: U8, labels: Sequence[str], *, least_score: float, most: int
    ) -> list[LabelBox]:
        """Boxes of labels in a picture, the surest first.

        Args:
            picture: uint8 (H, W, 3) RGB.
            labels: what to look for, at least one.
            least_score: less sure ones are left out.
            most: maximum number.

        Raises:
            InvalidInputError: a label is too long for the model.
            ForeignDataError: the model computes values that are not finite.
        """
        scores, numbers, edges = self._found(picture, labels, least_score)
        if not (np.isfinite(scores).all() and np.isfinite(edges).all()):
            raise ForeignDataError("The detector computes values that are not finite.")
        return [
            LabelBox(label=int(numbers[one]), score=float(scores[one]), edges_px=edges[one])
            for one in np.argsort(-scores, kind="stable")[:most]
        ]

    @abstractmethod
    def _found(
        self, picture: U8, labels: Sequence[str], least_score: float
    ) -> tuple[F64, NDArray[np.int64], F64]:
        """Scores (n,), indices of labels (n,) and edges (n, 4) [px]. Raises InvalidInputError."""

    def _run(self, picture: U8, text: Sequence[str]) -> tuple[Mapping[str, Any], Any]:
        """Inputs of the model, and what it makes of them."""
        inputs = self.processor(text=[list(text)], images=[picture], return_tensors="pt")
        inputs = inputs.to(self.device)
        self._check_length(inputs["input_ids"], text)
        with torch.inference_mode():
            return inputs, self.model(**inputs)

    @abstractmethod
    def _check_length(self, tokens: torch.Tensor, text: Sequence[str]) -> None:
        """Raise InvalidInputError if the model cannot read so much text."""


class Owlv2Detector(Detector):
    """OWLv2: each label is one sentence."""

    model_type = "owlv2"
    model_class = "Owlv2ForObjectDetection"

    def _found(
        self, picture: U8, labels: Sequence[str], least_score: float
    ) -> tuple[F64, NDArray[np.int64], F64]:
        _, outputs = self._run(picture, labels)
        (found,) = self.processor.post_process_grounded_object_detection(
            outputs, threshold=least_score, target_sizes=[picture.shape[:2]]
        )
        return _array(found["scores"]), found["labels"].cpu().numpy(), _array(found["boxes"])

    def _check_length(self, tokens: torch.Tensor, text: Sequence[str]) -> None:
        most = self.model.config.text_config.max_position_embeddings
        if tokens.shape[-1] > most:
            longest = max(text, key=len)
            raise InvalidInputError(
                f"The label {foreign.quoted(longest, 60)} is longer than the {most} tokens that "
                "the model reads.",
                path="labels",
            )


class GroundingDinoDetector(Detector):
    """Grounding DINO: all labels are one sentence, with a full stop after each.

    A box belongs to the label whose words it fits best; the library tells the fitting words only.
    """

    model_type = "grounding-dino"
    model_class = "GroundingDinoForObjectDetection"

    def _found(
        self, picture: U8, labels: Sequence[str], least_score: float
    ) -> tuple[F64, NDArray[np.int64], F64]:
        # a full stop would begin another label
        text = [label.replace(".", " ").strip() or "thing" for label in labels]
        inputs, outputs = self._run(picture, text)
        (found,) = self.processor.post_process_grounded_object_detection(
            outputs, inputs["input_ids"], threshold=least_score, target_sizes=[picture.shape[:2]]
        )
        fits = torch.sigmoid(outputs.logits[0])
        fits = fits[fits.max(dim=-1).values > least_score]
        numbers = _label_of_tokens(
            inputs["input_ids"][0], self.processor.tokenizer.convert_tokens_to_ids(".")
        )
        best = np.stack(
            [
                _array(fits[:, : len(numbers)])[:, numbers == number].max(axis=1)
                for number in range(len(text))
            ],
            axis=1,
        )
        return _array(found["scores"]), best.argmax(axis=1), _array(found["boxes"])

    def _check_length(self, tokens: torch.Tensor, text: Sequence[str]) -> None:
        most = self.model.config.max_text_len
        if tokens.shape[-1] > most:
            raise InvalidInputError(
                f"The labels have {tokens.shape[-1]} tokens, the model reads {most}.",
                hint="Name fewer.",
                path="labels",
            )


def _label_of_tokens(tokens: torch.Tensor, stop: int) -> NDArray[np.int64]:
    """Index of the label that each token (n,) belongs to; -1 for those of none."""
    is_stop = tokens.cpu().numpy() == stop
    numbers = np.cumsum(is_stop)
    numbers[is_stop] = -1
    numbers[[0, -1]] = -1  # the first and the last one only enclose the sentence
    return numbers


def _array(values: torch.Tensor) -> F64:
    return values.cpu().numpy().astype(np.float64)


FAMILIES: Mapping[str, type[Detector]] = {
    one.model_type: one for one in (Owlv2Detector, GroundingDinoDetector)
}
"""Classes by the `model_type` of config.json."""


def load_detector(folder: Path, device: str) -> Detector:
    """Read a checkpoint of any family. Raises as `Detector`."""
    try:
        config = foreign.table(foreign.read_json(folder / _CONFIG, most_bytes=1 << 20), _CONFIG)
    except OSError as error:
        raise CheckpointError(
            f"The checkpoint {folder} has no {_CONFIG}.",
            hint="Name a folder in the layout of the library transformers.",
        ) from error
    except ForeignDataError as error:
        raise CheckpointError(f"The checkpoint {folder} is damaged: {error}.") from error
    model_type = str(config.get("model_type"))
    family = FAMILIES.get(model_type)
    if family is None:
        raise CheckpointError(
            f"The checkpoint {folder} is of type {foreign.quoted(model_type, 60)}, expected one of "
            f"{', '.join(FAMILIES)}."
        )
    if config.get("use_pretrained_backbone"):
        raise CheckpointError(f"The checkpoint {folder} has no weights of its backbone.")
    if not any((folder / name).is_file() for name in _WEIGHTS):
        raise CheckpointError(f"The checkpoint {folder} has no {_WEIGHTS[0]}.")
    return family(folder, device)


def _line_of(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return foreign.printable(lines[0], 200)
