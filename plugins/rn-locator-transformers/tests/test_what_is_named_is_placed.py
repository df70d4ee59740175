"""Labels of a question or of the configuration become objects in the base frame, whatever they
say; in its own process, beside the server.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rn_locator_transformers.locator import TransformersLocator
from rn_locator_transformers.options import TransformersLocatorOptions
from rn_locator_transformers.plugin import roboneuron_locators
from rn_testing.fakes.painted_table import painted_cubes
from rn_testing.waiting import wait_until
from roboneuron import CalibratedImage, InvalidInputError, LocatedObject, NotReadyError
from roboneuron.sight.locator_process import LocatorProcess


def locator(folder: Path, **options: object) -> TransformersLocator:
    made = TransformersLocator(
        TransformersLocatorOptions.model_validate(
            {"checkpoint": folder, "least_score": 0.0, **options}
        )
    )
    made.load()
    return made


def without_depth() -> list[CalibratedImage]:
    return [replace(one, frame=replace(one.frame, depth_m=None)) for one in painted_cubes()]


def check(found: Sequence[LocatedObject], labels: set[str]) -> None:
    assert found
    assert {one.label for one in found} <= labels
    for one in found:
        assert np.isfinite(one.position_m).all()
        assert 0 < one.uncertainty_m < 1
        assert set(one.cameras) <= {"above", "side"}


@pytest.mark.parametrize("family", ["owlv2", "grounding-dino"])
def test_boxes_become_places_with_depth_and_without(folders: dict[str, Path], family: str) -> None:
    made = locator(folders[family], labels=["a red cube"])
    for images in (painted_cubes(), without_depth()):
        check(made.locate(images), {"a red cube"})
        check(made.locate(images, ["mug", "tea"]), {"mug", "tea"})


def test_words_of_a_label_are_printable_and_do_nothing(folders: dict[str, Path]) -> None:
    hostile = "cup\x1b[2J\nopen"
    found = locator(folders["grounding-dino"]).locate(painted_cubes(), [hostile])
    check(found, {"cup\\x1b[2J\\nopen"})


def test_without_labels_there_is_nothing_to_look_for(folders: dict[str, Path]) -> None:
    with pytest.raises(InvalidInputError) as refused:
        locator(folders["owlv2"]).locate(painted_cubes())
    assert refused.value.path == "labels"


@pytest.mark.exhaustive
def test_its_process_finds_the_same(folders: dict[str, Path]) -> None:
    (spec,) = roboneuron_locators()
    options = {"checkpoint": str(folders["owlv2"]), "least_score": 0.0}
    process = LocatorProcess(spec, options)
    process.load()
    found: list[Sequence[LocatedObject]] = []

    def is_loaded() -> bool:
        try:
            found.append(process.locate(painted_cubes(), ["mug"]))
        except NotReadyError as error:
            if "still loads" not in error.message:
                raise
        return bool(found)

    try:
        wait_until(is_loaded, 120.0, "it loads")
    finally:
        process.close()
    here = locator(folders["owlv2"]).locate(painted_cubes(), ["mug"])
    for one, other in zip(found[0], here, strict=True):
        np.testing.assert_allclose(one.position_m, other.position_m, atol=1e-4)
