"""Of several robots a page shows the one that was chosen on it, and stops that one; other pages go on with theirs."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from page_client import PageClient
from view_fakes import FakeSource, admission
from view_page import wait_until

from rn_view.options import ViewOptions
from rn_view.source import ModuleRow
from rn_view.viewer import Viewer

pytestmark = pytest.mark.filterwarnings("default:Queued a:UserWarning")
"""viser says so when a page is closed while it is being filled."""
STOP = "EMERGENCY STOP"


@pytest.fixture
def sources() -> dict[str, FakeSource]:
    """Two robots."""
    found = {"left": FakeSource(), "right": FakeSource()}
    for name, source in found.items():
        source.modules = (ModuleRow(kind="robot", health="ok", chosen=f"the {name} one"),)
    return found


@pytest.fixture
def look(sources: dict[str, FakeSource]) -> Iterator[Callable[..., PageClient]]:
    """Return a function that opens a page of both."""
    viewers, pages = [], []

    def open_page(*tokens: tuple[str, str]) -> PageClient:
        if not viewers:
            options = ViewOptions(enabled=True, port=0)
            viewers.append(Viewer(options, sources, admission(options, *tokens), None))
            viewers[0].open()
        pages.append(PageClient(viewers[0].url))
        wait_until(lambda: STOP in pages[-1].labels)
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()
    for viewer in viewers:
        viewer.close()


def test_a_page_shows_and_stops_the_robot_that_is_chosen_on_it(
    look: Callable[..., PageClient], sources: dict[str, FakeSource]
) -> None:
    page, other = look(), look()
    wait_until(lambda: "the left one" in page.text and "the left one" in other.text)
    assert not sources["right"].subscribed

    page.choose("Robot", "right")
    wait_until(lambda: "the right one" in page.text)
    assert "the left one" not in page.text
    assert sources["right"].subscribed
    assert sources["left"].subscribed  # the other page shows it

    page.press(STOP)
    assert sources["right"].stopped.wait(60)
    assert not sources["left"].stops
    wait_until(lambda: "EMERGENCY STOP LATCHED" in page.text)
    assert "EMERGENCY STOP LATCHED" not in other.text

    other.press(STOP)
    assert sources["left"].stopped.wait(60)
    other.close()
    wait_until(lambda: not sources["left"].subscribed)
    page.choose("Robot", "left")
    wait_until(lambda: "the left one" in page.text and not sources["right"].subscribed)


def test_a_page_without_a_token_stops_the_robot_that_is_chosen_on_it(
    look: Callable[..., PageClient], sources: dict[str, FakeSource]
) -> None:
    page = look(("a-token-for-looking-1", "viewer"))
    page.choose("Robot", "right")
    page.press(STOP)
    assert sources["right"].stopped.wait(60)
    assert not sources["left"].stops
    assert not sources["right"].subscribed


def test_one_robot_leaves_no_choice(serve: Callable[..., Viewer]) -> None:
    page = PageClient(serve().url)
    wait_until(lambda: "lift the" in page.text)
    assert STOP in page.labels
    assert "Robot" not in page.labels
    page.close()
