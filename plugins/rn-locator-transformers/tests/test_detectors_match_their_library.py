"""Boxes of both families are those that the library makes of the same folder: by its processors,
by its pipeline, and by the formulas of the papers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers

from rn_locator_transformers.detector import LabelBox, load_detector
from roboneuron import InvalidInputError

LABELS = ["a red cube", "mug"]
SIZES = [(48, 64), (97, 71)]
FAMILIES = ["owlv2", "grounding-dino"]
LABEL_ALONE = {"owlv2": "mug", "grounding-dino": "mug."}


def picture(height: int, width: int) -> np.ndarray:
    random = np.random.default_rng([height, width])
    return random.integers(0, 256, (height, width, 3)).astype(np.uint8)


def found(folder: Path, image: np.ndarray, labels: list[str], **options: Any) -> list[LabelBox]:
    chosen = {"least_score": 0.0, "most": 10_000} | options
    return load_detector(folder, "cpu").boxes(image, labels, **chosen)


def of_library(family: str, folder: Path, image: np.ndarray, labels: list[str]) -> Any:
    """Inputs and outputs of the model, by the library's classes for this family."""
    if family == "owlv2":
        processor = transformers.Owlv2Processor(
            transformers.Owlv2ImageProcessorPil.from_pretrained(folder),
            transformers.CLIPTokenizer.from_pretrained(folder),
        )
        model = transformers.Owlv2ForObjectDetection.from_pretrained(folder)
    else:
        processor = transformers.GroundingDinoProcessor(
            transformers.GroundingDinoImageProcessorPil.from_pretrained(folder),
            transformers.BertTokenizer.from_pretrained(folder),
        )
        model = transformers.GroundingDinoForObjectDetection.from_pretrained(folder)
    inputs = processor(text=[labels], images=[image], return_tensors="pt")
    with torch.no_grad():
        return processor, inputs, model.eval()(**inputs)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("family", FAMILIES)
def test_boxes_and_scores_are_those_of_the_processor(
    folders: dict[str, Path], family: str, size: tuple[int, int]
) -> None:
    image = picture(*size)
    processor, inputs, outputs = of_library(family, folders[family], image, LABELS)
    more = () if family == "owlv2" else (inputs["input_ids"],)
    (expected,) = processor.post_process_grounded_object_detection(
        outputs, *more, threshold=0.0, target_sizes=[size]
    )
    order = np.argsort(-expected["scores"].double().numpy(), kind="stable")
    ours = found(folders[family], image, LABELS)
    np.testing.assert_array_equal([one.score for one in ours], expected["scores"].numpy()[order])
    np.testing.assert_array_equal([one.edges_px for one in ours], expected["boxes"].numpy()[order])


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("family", FAMILIES)
def test_boxes_and_scores_follow_the_formulas(
    folders: dict[str, Path], family: str, size: tuple[int, int]
) -> None:
    """OWLv2 pads pictures to squares, so its boxes are parts of the longer side."""
    image = picture(*size)
    _, _, outputs = of_library(family, folders[family], image, LABELS)
    middle_x, middle_y, width, height = outputs.pred_boxes[0].double().numpy().T
    scale = [max(size)] * 2 if family == "owlv2" else [size[1], size[0]]
    edges = np.stack(
        [middle_x - width / 2, middle_y - height / 2, middle_x + width / 2, middle_y + height / 2],
        axis=1,
    ) * np.array([*scale, *scale])
    logits = outputs.logits[0].double().numpy()
    scores = 1 / (1 + np.exp(-logits.max(axis=1)))
    ours = found(folders[family], image, LABELS)
    # the network computes with 32 bits
    np.testing.assert_allclose([one.score for one in ours], -np.sort(-scores), atol=1e-6)
    for one in ours:
        off_px = np.abs(edges - one.edges_px).max(axis=1)
        assert off_px.min() < 1e-3 * max(size)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_label_alone_is_found_as_by_the_pipeline(folders: dict[str, Path], family: str) -> None:
    """The library's pipeline rounds edges down to whole pixels, and adds no full stop."""
    from PIL import Image

    image = picture(48, 64)
    pipeline = transformers.pipeline("zero-shot-object-detection", model=str(folders[family]))
    expected = pipeline(
        Image.fromarray(image), candidate_labels=[LABEL_ALONE[family]], threshold=0.3
    )
    ours = found(folders[family], image, ["mug"], least_score=0.3)
    assert len(ours) == len(expected) > 0
    for one, other in zip(ours, expected, strict=True):
        assert one.score == pytest.approx(other["score"], abs=1e-6)
        told = [other["box"][edge] for edge in ("xmin", "ymin", "xmax", "ymax")]
        np.testing.assert_array_equal(one.edges_px.astype(int), told)


def test_a_box_of_owlv2_has_the_label_that_fits_best(folders: dict[str, Path]) -> None:
    image = picture(48, 64)
    _, _, outputs = of_library("owlv2", folders["owlv2"], image, LABELS)
    order = outputs.logits[0].sigmoid().max(dim=-1).values.argsort(descending=True, stable=True)
    ours = found(folders["owlv2"], image, LABELS)
    assert [one.label for one in ours] == outputs.logits[0].argmax(dim=-1)[order].tolist()
    assert len({one.label for one in ours}) == 2


def test_a_box_of_grounding_dino_has_the_label_whose_words_fit_best(
    folders: dict[str, Path],
) -> None:
    """Tokens: [CLS] a red cube . mug . [SEP]"""
    image = picture(48, 64)
    _, inputs, outputs = of_library("grounding-dino", folders["grounding-dino"], image, LABELS)
    assert inputs["input_ids"].shape == (1, 8)
    fits = outputs.logits[0].sigmoid()
    expected = (fits[:, 5] > fits[:, 1:4].max(dim=-1).values).int()
    order = fits.max(dim=-1).values.argsort(descending=True, stable=True)
    ours = found(folders["grounding-dino"], image, LABELS)
    assert [one.label for one in ours] == expected[order].tolist()
    assert len({one.label for one in ours}) == 2


@pytest.mark.parametrize("family", FAMILIES)
def test_the_surest_are_kept(folders: dict[str, Path], family: str) -> None:
    image = picture(48, 64)
    every = found(folders[family], image, LABELS)
    few = found(folders[family], image, LABELS, most=3)
    assert [one.score for one in few] == [one.score for one in every[:3]]
    sure = found(folders[family], image, LABELS, least_score=0.5)
    assert [one.score for one in sure] == [one.score for one in every if one.score > 0.5]


@pytest.mark.parametrize("family", FAMILIES)
def test_labels_that_are_too_long_are_refused(folders: dict[str, Path], family: str) -> None:
    image = picture(48, 64)
    many = ["x" * 60] * (1 if family == "owlv2" else 16)
    with pytest.raises(InvalidInputError) as refused:
        found(folders[family], image, many)
    assert refused.value.path == "labels"


@pytest.mark.parametrize("label", ["mug. a red cube.", ".", "[SEP]", "[MASK] mug?"])
def test_a_label_is_one_label_whatever_it_says(folders: dict[str, Path], label: str) -> None:
    ours = found(folders["grounding-dino"], picture(48, 64), [label, "mug"])
    assert {one.label for one in ours} <= {0, 1}
    assert len(ours) == 12
