"""Controls of a recording on a page: slider, play and pause, speed, jumps to events."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rn_view.recordings.playback import SPEEDS, Playback
from rn_view.sources.source import PageState
from rn_view.visualization import markup

if TYPE_CHECKING:
    import viser

_MOST_MARKS = 40
"""Maximum number of dots below the slider; more could not be told apart."""
_HELD_S = 0.7
"""After a person moved the slider, it is not updated for this time, so that it does not move away
from the pointer.
"""


class PlaybackControls:
    """Controls of a recording on one page; `update` shows the present position."""

    def __init__(self, gui: viser.GuiApi, playback: Playback) -> None:
        from viser import Icon  # heavy

        self._playback = playback
        self._moved_s = 0.0
        self._icons = (Icon.PLAYER_PLAY, Icon.PLAYER_PAUSE)
        self._is_playing = playback.is_playing
        self._title = gui.add_html(markup.recording_text(playback, None))
        step = 1 + len(playback.marks) // _MOST_MARKS
        self._slider = gui.add_slider(
            "Time [s]",
            min=0.0,
            max=max(0.01, round(playback.duration_s, 2)),
            step=0.01,
            initial_value=0.0,
            marks=tuple(round(mark.at_s, 2) for mark in playback.marks[::step]),
        )
        self._slider.on_update(self._on_slider)
        self._play = gui.add_button("Play", icon=self._icons[0])
        self._play.on_click(lambda _: self._toggle())
        self._speed = gui.add_dropdown(
            "Speed", [f"{speed:g} x" for speed in SPEEDS], initial_value="1 x"
        )
        self._speed.on_update(self._on_speed)
        events = gui.add_button_group(
            "Event", ("previous", "next"), hint="calls, faults, instructions, stops"
        )
        events.on_click(lambda _: self._seek_mark(1 if events.value == "next" else -1))
        self._mark = gui.add_html("")

    def update(self, snapshot: PageState) -> None:
        """Show the present position."""
        playback = self._playback
        self._title.content = markup.recording_text(playback, snapshot)
        if time.monotonic() - self._moved_s > _HELD_S:
            self._slider.value = min(round(playback.position_s, 2), self._slider.max)  # type: ignore[misc]
        if playback.is_playing != self._is_playing:
            self._is_playing = playback.is_playing
            self._play.label = "Pause" if self._is_playing else "Play"
            self._play.icon = self._icons[self._is_playing]
        here = [mark for mark in playback.marks if mark.at_s <= playback.position_s + 1e-6]
        self._mark.content = markup.mark_text(here[-1], playback.position_s) if here else ""
        self._speed.value = f"{playback.speed:g} x"  # type: ignore[misc]

    def _on_slider(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is not None:  # moved by a person, not by `update`
            self._moved_s = time.monotonic()
            self._playback.seek(self._slider.value)

    def _on_speed(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client is not None:
            self._playback.set_speed(float(self._speed.value.split()[0]))

    def _toggle(self) -> None:
        if self._playback.is_playing:
            self._playback.pause()
        else:
            self._playback.play()

    def _seek_mark(self, step: int) -> None:
        self._moved_s = 0.0
        self._playback.seek_mark(step)
