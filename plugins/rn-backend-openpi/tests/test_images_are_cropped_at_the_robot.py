"""Parts of an image that the checkpoint does not use are not sent, which changes no answer by a
bit.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import RunningServer, robot_of

from rn_backend_openpi import coding as coding_module
from rn_backend_openpi.coding import Coder
from rn_backend_openpi.images import crop, decode_image
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.shared_backend import SharedBackend
from rn_backend_openpi.shared_case import install, options_in
from rn_backend_openpi.shared_options import SharedOptions
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    ActionChunk,
    CameraCalibration,
    ConfigurationError,
    InvalidInputError,
    Observation,
)

pytestmark = pytest.mark.timeout(200)
RECTANGLE = (80, 60, 200, 120)


def seen(number: int = 0, width: int = 320, height: int = 240) -> Observation:
    observation = make_observation(SHARED)
    image = np.random.default_rng(number).integers(0, 256, (height, width, 3), dtype=np.uint8)
    calibration = CameraCalibration(
        intrinsics=np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
        mount="base",
        T_mount_camera=np.eye(4),
    )
    frame = replace(observation.frames["primary"], image=image, calibration=calibration)
    return replace(observation, frames={"primary": frame})


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """A server whose models crop."""
    folder = tmp_path_factory.mktemp("served")
    listen = {"keys": "token", "token_file": str(folder / "token")}
    crops = {"primary": list(RECTANGLE)}
    models = {
        "crops": {"crop": crops},
        "shrinks": {"crop": crops, "options": {"shrinks_to": [64, 48]}},
        "whole": {},
    }
    made = RunningServer(folder, models, listen)
    try:
        yield made.start()
    finally:
        made.end()


@pytest.fixture
def robot(server: RunningServer) -> Iterator[Callable[..., SharedBackend]]:
    """Return a function that creates a loaded backend of the server."""
    with ExitStack() as stack:

        def make(model: str, **options: Any) -> SharedBackend:
            token = str(server.folder / "token")
            given = {"token_file": token, "coding": "raw", **options}
            made = robot_of(server.address, **given, model=model)
            stack.callback(made.close)
            made.load()
            return made

        yield make


def test_cropped_at_the_robot_equals_cropped_at_the_server_bit_for_bit(
    robot: Callable[..., SharedBackend], server: RunningServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = {model: robot(model) for model in ("crops", "shrinks")}
    # this robot ignores the server's instructions, so the server crops
    monkeypatch.setattr(coding_module, "crop", lambda frame, rectangle: frame)
    monkeypatch.setattr(coding_module, "CROPPED", "unheard")
    monkeypatch.setattr(coding_module, "fit", lambda frame, size: frame)
    whole = {model: robot(model) for model in here}
    there = {
        (model, number): one.predict(seen(number))
        for model, one in whole.items()
        for number in range(5)
    }
    monkeypatch.undo()
    monkeypatch.syspath_prepend(str(server.folder / "site"))
    reflex = importlib.import_module("rn_reflex_plugin")
    monkeypatch.delitem(sys.modules, "rn_reflex_plugin")
    alone = reflex.Reflex(reflex.Options())
    alone.load()
    for (model, number), far in there.items():
        near = here[model].predict(seen(number))
        assert near.actions.tobytes() == far.actions.tobytes(), (model, number)
        least = {"crops": 200 * 120 * 3, "shrinks": 64 * 48 * 3}[model]
        assert near.metrics["shared.image_kb"] == least / 1e3
        assert far.metrics["shared.image_kb"] == 320 * 240 * 3 / 1e3
        if model == "crops":
            cropped = crop(seen(number).frames["primary"], RECTANGLE)
            by_hand = alone.predict(replace(seen(number), frames={"primary": cropped}))
            assert by_hand.actions.tobytes() == near.actions.tobytes()


def test_a_crop_of_the_robot_alone_is_checked_by_how_far_actions_move(
    robot: Callable[..., SharedBackend],
) -> None:
    crops = {"primary": RECTANGLE}
    loose = robot("whole", crop=crops, parity_m=1.0, parity_rad=1.0)
    metrics = loose.predict(seen()).metrics
    assert metrics["shared.parity_m"] > 0.0
    assert metrics["shared.image_kb"] == 200 * 120 * 3 / 1e3
    with pytest.raises(ConfigurationError, match="look at crop"):
        robot("whole", crop=crops, parity_m=0.0, parity_rad=0.0).predict(seen())
    with pytest.raises(ConfigurationError, match=r"to \[80, 60, 200, 120\].*says \[0, 0, 9, 9\]"):
        robot("crops", crop={"primary": (0, 0, 9, 9)})


def test_an_image_that_does_not_hold_the_crop_is_an_error_of_that_robot(
    robot: Callable[..., SharedBackend],
) -> None:
    one = robot("crops")
    with pytest.raises(InvalidInputError, match=r"is 100 x 240, `crop` takes 200 x 120 at 80, 60"):
        one.predict(seen(width=100))
    assert one.predict(seen())


@pytest.mark.exhaustive
def test_a_server_of_this_machine_crops_too(tmp_path: Path) -> None:
    install(tmp_path)
    given = options_in(tmp_path, idle_s=0.5, crop={"primary": RECTANGLE})
    one = SharedBackend(SharedOptions.model_validate(given))
    plain = SharedBackend(SharedOptions.model_validate(options_in(tmp_path, idle_s=0.5)))
    try:
        one.load()
        plain.load()
        cropped = crop(seen().frames["primary"], RECTANGLE)
        by_hand = plain.predict(replace(seen(), frames={"primary": cropped}))
        assert one.predict(seen()).actions.tobytes() == by_hand.actions.tobytes()
    finally:
        one.close()
        plain.close()


def test_a_cropped_image_shows_the_same_and_its_calibration_too() -> None:
    frame = seen().frames["primary"]
    part = crop(frame, RECTANGLE)
    assert part.image.shape == (120, 200, 3)
    np.testing.assert_array_equal(part.image[5, 7], frame.image[65, 87])
    assert frame.calibration is not None
    assert part.calibration is not None
    point = np.array([0.1, -0.05, 1.0])
    before, after = (known.intrinsics @ point for known in (frame.calibration, part.calibration))
    np.testing.assert_allclose(after[:2], before[:2] - RECTANGLE[:2])
    for outside in ((121, 0, 200, 120), (0, 121, 200, 120)):
        with pytest.raises(InvalidInputError):
            crop(frame, outside)


def test_what_is_cropped_as_the_server_says_is_asked_once() -> None:
    asked: list[tuple[int, ...]] = []

    def ask(document: Document, deadline_s: float) -> ActionChunk:
        asked.append(decode_image(document["observation/image"]).shape)
        assert document[RESERVED]["frames"]["primary"]["cropped"] is True
        rows = np.full((2, 7), 0.01)
        return ActionChunk(actions=rows, step_s=0.1, metrics={"shared.link_ms": 1.0})

    options = SharedOptions(address="gpu:1", coding="raw")
    one = Coder(options, {"primary": (50, 30)}, 0.001, crops={"primary": RECTANGLE})
    one.ask(seen(), ask, float("inf"))
    assert asked == [(30, 50, 3)]
