"""Images are shrunk and coded according to the link, without affecting the actions."""

from __future__ import annotations

import contextlib
import io
import itertools
import struct
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from rn_backend_openpi.coding import (
    CODINGS,
    Coder,
    Coding,
    LinkMeter,
    distances,
    encode_image,
    fit,
    image_bytes,
)
from rn_backend_openpi.messages import Document, decode_image, to_observation
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_backend_servo.case import contract_case
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    ActionChunk,
    CameraCalibration,
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    Observation,
    RoboNeuronError,
    UngroundedError,
)

U8 = NDArray[np.uint8]
MBIT = 1e6 / 8


def picture(width: int = 224, height: int = 224) -> U8:
    """A gradient with the noise of a camera."""
    rows, columns = np.mgrid[:height, :width]
    smooth = np.stack([columns * 255 / width, rows * 255 / height, (rows + columns) % 256], -1)
    noise = np.random.default_rng(0).integers(-4, 5, smooth.shape)
    return (smooth.astype(int) + noise).clip(0, 255).astype(np.uint8)


def seen(image: U8 | None = None) -> Observation:
    observation = make_observation(SHARED)
    frame = observation.frames["primary"]
    calibration = CameraCalibration(
        intrinsics=np.array([[300.0, 0, 112], [0, 300, 112], [0, 0, 1]]),
        mount="base",
        T_mount_camera=np.eye(4),
    )
    shown = replace(frame, image=picture() if image is None else image, calibration=calibration)
    return replace(observation, frames={"primary": shown})


def test_raw_and_png_lose_nothing_and_jpeg_little_and_less_with_quality() -> None:
    for image in (picture(), picture(7, 3), np.zeros((1, 1, 3), np.uint8)):
        for coding in CODINGS[:2]:
            assert decode_image(encode_image(image, coding, 90)).tobytes() == image.tobytes()
    far = [
        np.abs(decode_image(encode_image(picture(), "jpeg", q)).astype(int) - picture()).mean()
        for q in (30, 95)
    ]
    assert far[1] < far[0] < 8.0


def announced(data: bytes, **changed: object) -> Document:
    return {
        "coding": "png",
        "height": 4,
        "width": 4,
        "data": np.frombuffer(data, np.uint8),
        **changed,
    }


def saved(kind: str, mode: str = "RGB", size: tuple[int, int] = (4, 4)) -> bytes:
    made = io.BytesIO()
    Image.new(mode, size).save(made, kind)
    return made.getvalue()


def bomb() -> bytes:
    """A PNG of a few bytes that announces 60,000 x 60,000 pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunks = struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    return b"\x89PNG\r\n\x1a\n" + chunks


@pytest.mark.parametrize(
    "value",
    [
        announced(saved("png", size=(5, 4))),
        announced(saved("jpeg", "CMYK"), coding="jpeg"),
        announced(saved("gif")),
        announced(saved("png")[:45]),
        announced(saved("png"), coding="webp"),
        announced(saved("png"), height=0),
        announced(b""),
        announced(bomb(), height=60_000, width=60_000),
        announced(bomb()),
        "text",
        None,
    ],
)
def test_what_is_no_such_image_is_refused(value: object) -> None:
    with pytest.raises(ForeignDataError):
        decode_image(value)


@given(data=st.data())
@settings(max_examples=60)
def test_a_damaged_image_is_decoded_or_refused(data: st.DataObject) -> None:
    coding: Coding = data.draw(st.sampled_from(("png", "jpeg")))
    value = encode_image(picture(16, 16), coding, 90)
    assert isinstance(value, dict)
    damaged = value["data"].copy()
    for _ in range(data.draw(st.integers(1, 5))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(ForeignDataError):
        assert decode_image({**value, "data": damaged}).shape == (16, 16, 3)


def test_a_shrunk_image_shows_the_same_and_its_calibration_too() -> None:
    frame = seen(picture(640, 480)).frames["primary"]
    small = fit(frame, (320, 160))
    assert small.image.shape == (160, 320, 3)
    assert frame.calibration is not None
    assert small.calibration is not None
    point = np.array([0.1, -0.05, 1.0])
    before, after = (known.intrinsics @ point for known in (frame.calibration, small.calibration))
    np.testing.assert_allclose(after[:2], before[:2] * [0.5, 1 / 3])
    # images are never enlarged
    assert fit(small, (640, 480)) is small
    assert fit(small, (320, 160)) is small


class Far:
    """A server behind a link: its answer is the mean of the image, plus noise; `errors` are its
    first answers, None for a chunk.
    """

    def __init__(
        self,
        bytes_per_s: float = 5 * MBIT,
        *errors: RoboNeuronError | None,
        noise: float = 0.0,
        gain: float = 0.0,
    ) -> None:
        self.bytes_per_s, self.noise, self.gain = bytes_per_s, noise, gain
        self.errors = list(errors)
        self.asked: list[tuple[str, tuple[int, ...], int]] = []
        self._drawn = np.random.default_rng(0)

    def ask(self, document: Document, deadline_s: float) -> ActionChunk:
        sent = document["observation/image"]
        coding = "raw" if isinstance(sent, np.ndarray) else sent["coding"]
        size, image = image_bytes(sent), decode_image(sent)
        self.asked.append((coding, image.shape, size))
        error = self.errors.pop(0) if self.errors else None
        if error is not None:
            raise error
        rows = np.full((4, 7), 0.01 + self.gain * float(image.astype(float).std()))
        rows[:, :6] += self.noise * self._drawn.normal(size=(4, 6))
        rows[:, 6] = 0.5
        link_ms = 1.0 + 1e3 * size / self.bytes_per_s
        return ActionChunk(actions=rows, step_s=0.1, metrics={"shared.link_ms": link_ms})


@pytest.fixture
def even_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoding and decoding take a millisecond each, however busy this machine is."""
    looks = itertools.count()
    monkeypatch.setattr("rn_backend_openpi.coding.time.monotonic", lambda: 1e-3 * next(looks))


def coder(**options: Any) -> Coder:
    return Coder(PolicyOptions(address="gpu:1", **options), {}, 0.001)


def ask(one: Coder, far: Far, observation: Observation | None = None) -> ActionChunk:
    return one.ask(observation or seen(), far.ask, float("inf"))


@pytest.mark.parametrize(
    ("rate", "expected"), [(1000 * MBIT, "raw"), (60 * MBIT, "png"), (5 * MBIT, "jpeg")]
)
def test_the_coding_follows_what_the_link_carries(rate: float, expected: str) -> None:
    meter = LinkMeter(share=0.3)
    sizes: dict[Coding, tuple[int, float]] = {
        "raw": (150_000, 0.0),
        "png": (80_000, 0.003),
        "jpeg": (12_000, 0.001),
    }
    meter.note_base(0.001)
    for coding, (size, coding_s) in sizes.items():
        meter.note(coding, size, coding_s, 0.001 + size / rate)
    meter.settle(0.05, CODINGS)
    assert meter.current == expected
    assert meter.cost_s("raw") == pytest.approx(150_000 / rate)


def test_small_images_that_take_one_round_trip_make_no_room_for_large_ones() -> None:
    meter = LinkMeter(share=0.3)
    meter.note_base(0.150)
    for _ in range(20):
        meter.note("png", 80_000, 0.003, 0.250)
        meter.assume("raw", 150_000)
        for _ in range(5):
            meter.note("jpeg", 12_000, 0.001, 0.150)
            meter.choose(0.05, CODINGS)
    assert meter.current == "jpeg"


def test_one_hiccup_changes_nothing_and_a_slower_link_does(even_clock: None) -> None:
    far, one = Far(1000 * MBIT), coder()
    for _ in range(3):
        ask(one, far)
    assert one.coding == "raw"
    far.bytes_per_s = MBIT
    ask(one, far)
    far.bytes_per_s = 1000 * MBIT
    for _ in range(20):
        ask(one, far)
    assert one.coding == "raw"
    far.bytes_per_s = 5 * MBIT
    for _ in range(20):
        ask(one, far)
    assert one.coding == "jpeg"
    far.bytes_per_s = 1000 * MBIT
    for _ in range(250):
        ask(one, far)
    assert one.coding == "raw", "it comes back, by way of PNG"


def test_a_larger_coding_is_tried_now_and_then_where_no_deadline_is_at_risk() -> None:
    meter = LinkMeter(share=0.3)
    meter.note_base(0.001)
    for coding, size in (("raw", 900_000), ("png", 500_000), ("jpeg", 60_000)):
        meter.note(coding, size, 0.001, size / 30_000)  # type: ignore[arg-type]
    meter.settle(0.05, CODINGS)
    assert meter.current == "jpeg"
    assert meter.probe(CODINGS, 0.375) == "jpeg", "the link is too slow for that"
    for _ in range(5):
        meter.note("jpeg", 60_000, 0.001, 0.004)
    assert meter.probe(CODINGS, 0.375) == "png"
    meter.note("png", 500_000, 0.003, 0.011)
    for _ in range(5):
        meter.choose(0.05, CODINGS)
    assert meter.current == "png", "what was measured before the link became better is forgotten"
    assert meter.probe(CODINGS, 0.375) == "raw"


def test_parity_is_measured_before_the_first_action_and_told(even_clock: None) -> None:
    far, one = Far(5 * MBIT, gain=1e-4), coder(coding="jpeg", quality=30)
    chunk = ask(one, far)
    assert [coding for coding, *_ in far.asked] == ["png", "png", "jpeg", "jpeg"]
    assert 0.0 < chunk.metrics["shared.parity_m"] < 0.002
    assert chunk.metrics["shared.coding"] == 2.0
    assert chunk.metrics["shared.image_kb"] < 10.0
    ask(one, far)
    assert len(far.asked) == 5


def test_coding_that_moves_actions_too_far_is_refused(even_clock: None) -> None:
    far = Far(5 * MBIT, gain=1e-2)
    with pytest.raises(ConfigurationError, match=r"parity_m = 0\.002"):
        ask(coder(coding="jpeg", quality=30), far)
    one = coder(quality=30)
    for _ in range(3):
        assert ask(one, far).metrics["shared.coding"] < 2.0
    assert one.coding == "png", "what loses nothing is used in its place"
    assert ask(coder(coding="jpeg", quality=30, parity_m=1.0, parity_rad=1.0), far)


def test_what_a_model_draws_at_random_is_no_fault_of_the_coding() -> None:
    metrics = ask(coder(coding="jpeg"), Far(noise=1e-3)).metrics
    assert metrics["shared.parity_m"] < 0.002


@pytest.mark.parametrize("coding", ["raw", "png"])
def test_without_loss_nothing_is_asked_twice_and_a_model_may_remember(coding: str) -> None:
    far = Far(5 * MBIT, None, UngroundedError("seen"))
    ask(coder(coding=coding), far)
    assert [one for one, *_ in far.asked] == [coding]


def test_images_are_shrunk_to_what_the_model_declares() -> None:
    far, options = Far(), PolicyOptions(address="gpu:1", coding="raw")
    ask(Coder(options, {"primary": (64, 48)}, 0.001), far)
    assert [shape for _, shape, _ in far.asked] == [(48, 64, 3)]


def test_distances_are_told_by_unit() -> None:
    rows = np.zeros((2, 7))
    moved = rows.copy()
    moved[1, 1], moved[0, 4] = 0.5, -0.25
    one, other = (ActionChunk(actions=r, step_s=0.1) for r in (rows, moved))
    assert distances(one, other) == {"m": 0.5, "rad": 0.25}
    assert distances(one, ActionChunk(actions=rows[:1], step_s=0.1))["m"] == float("inf")


@pytest.mark.parametrize("place", [1, 2])
@pytest.mark.parametrize("coding", ["auto", "jpeg"])
def test_a_model_that_refuses_what_it_has_seen_is_said_to_remember(place: int, coding: str) -> None:
    far = Far(5 * MBIT, *[None] * place, UngroundedError("The image has not changed."))
    with pytest.raises(ConfigurationError) as caught:
        ask(coder(coding=coding), far)
    assert "keeps a history of observations" in caught.value.message
    assert "The image has not changed." in caught.value.message
    for word in ("stateless = true", "coding = 'raw'"):
        assert word in caught.value.hint


@pytest.mark.parametrize(
    ("errors", "kind"),
    [([UngroundedError("no cube")], UngroundedError), ([None, NotReadyError("l")], NotReadyError)],
)
def test_other_errors_are_told_as_they_are(
    errors: list[RoboNeuronError | None], kind: type[RoboNeuronError]
) -> None:
    one, far = coder(), Far(5 * MBIT, *errors)
    with pytest.raises(kind):
        ask(one, far)
    assert ask(one, far).metrics["shared.parity_m"] < 0.002


def test_the_visual_servoing_is_one_that_remembers() -> None:
    case = contract_case()
    assert case.observe is not None
    servo = case.build()
    servo.load()

    def answer(document: Document, deadline_s: float) -> ActionChunk:
        chunk = servo.predict(to_observation(document))
        return replace(chunk, metrics={"shared.link_ms": 1.0})

    with pytest.raises(ConfigurationError, match="keeps a history of observations"):
        coder().ask(case.observe(), answer, float("inf"))
