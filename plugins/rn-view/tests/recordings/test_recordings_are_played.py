"""What a page shows of a recording at a moment: everything as it was then, whichever way one got
there.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

import pytest
from recorded_fakes import BEGIN_NS, LENGTH_S, record, shade

from rn_testing.fakes import fake_registry
from rn_view.sources.measured_topics import MeasuredTopics
from rn_view.visualization.plots import History
from rn_view_attached.command import ViewCommand
from rn_view_recorded.source import RecordedSource
from roboneuron import (
    ACTION_LABEL,
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    StateError,
)
from roboneuron.config import load_config
from roboneuron.plugins.registry import Registry


class Cinema:
    """A recording, somebody who looks, and a clock that a test moves."""

    def __init__(self, files: list[Path], registry: Registry) -> None:
        self.now_s = 0.0
        self.source = RecordedSource(
            "a-run", files, load_config(None), registry, clock=lambda: self.now_s
        )
        self.playback = self.source.playback
        self.measured = MeasuredTopics(self.source, self.source.profile())
        self.measured.open()
        self.source.step()

    def wait(self, seconds: float) -> None:
        """Let time pass in steps, as the player does."""
        for _ in range(round(seconds / 0.02)):
            self.now_s += 0.02
            self.source.step()

    def seek(self, position_s: float) -> None:
        """Move the slider."""
        self.playback.seek(position_s)
        self.source.step()

    def shades(self) -> dict[str, int]:
        """Grey level of each camera's picture."""
        return {
            camera: int(pixels[0, 0, 0]) for camera, (_, pixels, _) in self.measured.images.items()
        }

    def texts(self) -> list[str]:
        """Texts of the events so far, newest first."""
        return [event.text for event in self.source.shown_events.newest(99)]


@pytest.fixture
def cinema(tmp_path: Path) -> Cinema:
    """The recording of recorded_fakes.py."""
    return Cinema(record(tmp_path), fake_registry())


def test_the_slider_shows_everything_as_it_was(cinema: Cinema) -> None:
    cinema.seek(1.3)
    measured = cinema.measured
    assert measured.joints["slide_x"] == pytest.approx(0.13)
    pose = measured.tracks[""].pose
    assert pose is not None
    assert pose[0][0] == pytest.approx(0.13)
    at_s, label, action = measured.actions[-1]
    assert label == ACTION_LABEL
    assert at_s == pytest.approx(BEGIN_NS / 1e9 + 1.3)
    assert action == (0.001 * 13, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    assert len(measured.actions) == 14  # of all seconds before, for the plots
    assert cinema.shades() == {"front": shade(13), "hand": pytest.approx(shade(13), abs=2)}  # JPEG
    assert measured.images["front"][2] == 13 * 10**9
    snapshot = cinema.source.snapshot()
    inference = next(row for row in snapshot.modules if row.kind == "inference")
    assert (inference.health, inference.rate_hz) == ("failing", pytest.approx(11.2))
    assert (snapshot.instruction, snapshot.is_latched) == ("pull", True)
    assert "ann: too fast" in snapshot.cause
    assert 'start_inference(instruction="push"): done, 0.15 s' in cinema.texts()
    assert any("latched" in text for text in cinema.texts())


def test_going_back_shows_nothing_of_what_came_later(cinema: Cinema) -> None:
    cinema.seek(LENGTH_S)
    assert not cinema.source.snapshot().is_latched  # it was reset at 1.6 s
    cinema.seek(0.5)
    assert cinema.texts() == ['start_inference(instruction="push"): done, 0.15 s']
    snapshot = cinema.source.snapshot()
    assert (snapshot.instruction, snapshot.is_latched) == ("push", False)
    assert max(point[0] for point in cinema.measured.tracks[""].trail) <= 0.05 + 1e-9
    assert max(action.at_s for action in cinema.measured.actions) <= BEGIN_NS / 1e9 + 0.5 + 1e-6
    cinema.seek(0.0)
    assert cinema.texts() == []
    assert len(cinema.measured.actions) == 1


def test_playing_shows_the_same_as_jumping(tmp_path: Path) -> None:
    files = record(tmp_path)
    playing, jumping = Cinema(files, fake_registry()), Cinema(files, fake_registry())
    playing.playback.play()
    playing.wait(1.3)
    assert playing.playback.position_s == pytest.approx(1.3)
    jumping.seek(playing.playback.position_s)
    for name in ("joints", "actions"):
        assert getattr(playing.measured, name) == getattr(jumping.measured, name)
    assert playing.shades() == jumping.shades()
    assert playing.source.snapshot() == jumping.source.snapshot()
    assert playing.texts() == jumping.texts()


def test_it_pauses_stops_at_the_end_and_begins_again(cinema: Cinema) -> None:
    cinema.playback.play(speed=4.0)
    cinema.wait(0.2)
    assert cinema.playback.position_s == pytest.approx(0.8)
    cinema.playback.pause()
    cinema.wait(1.0)
    assert cinema.playback.position_s == pytest.approx(0.8)
    cinema.playback.play()
    cinema.wait(5.0)
    assert (cinema.playback.position_s, cinema.playback.is_playing) == (LENGTH_S, False)
    cinema.playback.play(speed=1.0)
    cinema.wait(0.1)
    assert cinema.playback.position_s < 0.2


def test_time_stands_still_while_nobody_looks(cinema: Cinema) -> None:
    cinema.playback.play()
    cinema.measured.close()
    cinema.wait(1.0)
    assert cinema.playback.position_s == 0.0
    cinema.measured.open()
    cinema.wait(0.5)
    assert 0.4 < cinema.playback.position_s <= 0.5
    assert cinema.measured.joints  # a page that comes later sees what is there


def test_events_are_jumped_to(cinema: Cinema) -> None:
    found = []
    while (mark := cinema.playback.seek_mark(1)) is not None:
        found.append(mark)
    # marks of one moment are one jump
    assert [round(mark.at_s, 2) for mark in found] == [0.2, 1.2, 1.6]
    texts = [mark.text for mark in cinema.playback.marks]
    assert not any("get_status" in text for text in texts)
    assert "instruction: pull" in texts
    assert "emergency stop latched" in texts
    before = cinema.playback.seek_mark(-1)
    assert before is not None
    assert before.at_s == pytest.approx(0.2)  # 1.2 s is too near to be the event before
    assert cinema.playback.seek_mark(-1) is None


def test_a_file_that_was_cut_short_is_played(tmp_path: Path) -> None:
    cinema = Cinema(record(tmp_path, whole=False), fake_registry())
    cinema.seek(1.3)
    assert cinema.shades()["front"] == shade(13)


def test_plots_end_at_the_time_that_is_shown(cinema: Cinema) -> None:
    history = History()
    for position_s in (0.5, 1.0, 1.9, 0.7):
        cinema.seek(position_s)
        history.add(cinema.source.snapshot(), cinema.source.now_s())
    ages = history.series(1, cinema.source.now_s())[0]
    assert ages.tolist() == pytest.approx([-0.2, 0.0], abs=1e-6)


def test_no_robot_is_stopped_by_a_recording(cinema: Cinema) -> None:
    with pytest.raises(StateError, match="recording"):
        cinema.source.press_stop("somebody")


def command(words: list[str]) -> Namespace:
    parser = ArgumentParser()
    ViewCommand().configure(parser)
    return parser.parse_args(words)


def test_the_command_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(words: list[str]) -> object:
        return ViewCommand().run(command([*words, "--port", "0"]))

    with pytest.raises(InvalidInputError, match="No run begins with 'monday'"):
        run(["--run", "monday", "--directory", str(tmp_path)])
    with pytest.raises(ConfigurationError, match="needs --run"):
        run(["--directory", str(tmp_path)])
    monkeypatch.setitem(__import__("sys").modules, "rn_recorder_runs.command", None)
    with pytest.raises(MissingDependencyError, match="not installed"):
        run(["--run", "latest"])
