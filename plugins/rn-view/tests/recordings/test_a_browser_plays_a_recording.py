"""A recording in a real browser: slider, play and pause, jumps, and no button that would stop
nothing.
"""

from __future__ import annotations

import time

import pytest
from recorded_fakes import LENGTH_S, record, shade
from view_fakes import admission
from view_page import PIXEL, wait_until

from rn_testing.fakes import fake_registry
from rn_view.options import ViewOptions
from rn_view.web.view_server import ViewServer
from rn_view_recorded.source import RecordedSource
from roboneuron.config import load_config

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default:Queued a:UserWarning")]


@pytest.fixture
def recorded(tmp_path):
    """A page that plays a recording."""
    source = RecordedSource("monday", record(tmp_path), load_config(None), fake_registry())
    options = ViewOptions(port=0)
    viewer = ViewServer(options, source, admission(options), None)
    viewer.open()
    source.open()
    yield source, viewer
    source.close()
    viewer.close()


def test_a_recording_is_watched_with_slider_and_buttons(recorded, look):
    source, viewer = recorded
    page = look(viewer.url, "monday")
    page.get_by_text("no robot is connected").wait_for()
    assert page.get_by_text("EMERGENCY STOP").count() == 0

    page.get_by_role("slider").first.focus()
    page.keyboard.press("End")
    wait_until(lambda: source.playback.position_s == LENGTH_S)
    wait_until(lambda: abs(page.evaluate(PIXEL) - shade(20)) <= 3)
    page.get_by_text("reset_emergency_stop").first.wait_for()

    page.get_by_role("button", name="previous").click()
    # the emergency stop, not its release
    wait_until(lambda: 1.1 < source.playback.position_s < 1.3)
    page.get_by_text("Emergency stop latched: ann: too fast").wait_for()
    wait_until(lambda: abs(page.evaluate(PIXEL) - shade(12)) <= 3)
    page.get_by_text("pull", exact=True).wait_for()

    beside = look(viewer.url, "monday")  # a page that comes while it is paused sees the same
    wait_until(lambda: abs(beside.evaluate(PIXEL) - shade(12)) <= 3)
    beside.context.close()

    # as slow as possible, so that the page can press Pause before the end
    source.playback.set_speed(0.1)
    page.get_by_role("button", name="Play").click()
    wait_until(lambda: source.playback.is_playing)
    page.get_by_role("button", name="Pause").click()
    wait_until(lambda: not source.playback.is_playing)

    source.playback.seek(0.0)
    source.playback.play()
    page.context.close()
    wait_until(lambda: viewer.measured is None)
    here_s = source.playback.position_s
    time.sleep(0.2)
    assert source.playback.position_s == here_s  # nobody looks
