"""Of several robots a page shows the one that was chosen on it; each has a stop of its own, beside
the one of all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from urllib.error import HTTPError

import pytest
from page_client import PageClient
from view_fakes import FakeOperator, FakeSource, admission
from view_page import wait_until

from rn_view.options import ViewOptions
from rn_view.sources.source import ModuleRow
from rn_view.web.view_server import ViewServer

pytestmark = pytest.mark.filterwarnings("default:Queued a:UserWarning")
"""viser says so when a page is closed while it is being filled."""


@pytest.fixture
def sources() -> dict[str, FakeSource]:
    """Two robots."""
    found = {"left": FakeSource(), "right": FakeSource()}
    for name, source in found.items():
        source.modules = (ModuleRow(kind="robot", health="ok", chosen=f"the {name} one"),)
    return found


@pytest.fixture
def look(sources: dict[str, FakeSource]) -> Iterator[Callable[..., PageClient]]:
    """Return a function that opens a page with both."""
    viewers, pages = [], []

    def open_page(*tokens: tuple[str, str]) -> PageClient:
        if not viewers:
            options = ViewOptions(enabled=True, port=0)
            viewers.append(ViewServer(options, sources, admission(options, *tokens), None))
            viewers[0].open()
        pages.append(PageClient(viewers[0].url))
        wait_until(lambda: "Robot" in pages[-1].labels)
        return pages[-1]

    yield open_page
    for page in pages:
        page.close()
    for viewer in viewers:
        viewer.close()


def test_a_page_shows_the_robot_that_is_chosen_on_it(
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

    page.press_stop("right")
    assert not sources["left"].stops
    wait_until(lambda: "EMERGENCY STOP LATCHED" in page.text)
    assert "EMERGENCY STOP LATCHED" not in other.text

    other.close()
    wait_until(lambda: not sources["left"].subscribed)
    page.choose("Robot", "left")
    wait_until(lambda: "the left one" in page.text and not sources["right"].subscribed)


def test_the_large_stop_is_of_all_robots_and_each_has_one(
    look: Callable[..., PageClient], sources: dict[str, FakeSource]
) -> None:
    page = look(("a-token-for-looking-1", "viewer"))
    page.press_stop("right")
    assert (len(sources["left"].stops), len(sources["right"].stops)) == (0, 1)
    with pytest.raises(HTTPError, match="404"):
        page.press_stop("nobody")
    assert "left: Latched." in page.press_stop()
    assert (len(sources["left"].stops), len(sources["right"].stops)) == (1, 2)
    assert not sources["right"].subscribed  # a page without a token shows nothing else


def test_a_robot_that_joins_is_on_the_page_of_the_others(operator: FakeOperator) -> None:
    options = ViewOptions(enabled=True, port=0)
    first, second = FakeSource(), FakeSource()
    viewer = ViewServer(options, {"left": first}, admission(options), operator)
    viewer.open()
    pages = [PageClient(viewer.url)]
    try:
        wait_until(lambda: "lift the" in pages[0].text)
        assert "Robot" not in pages[0].labels
        viewer.join("right", second, FakeOperator())
        wait_until(lambda: pages[0].is_closed)
        pages.append(PageClient(viewer.url))
        wait_until(lambda: "Robot" in pages[1].labels and "lift the" in pages[1].text)
        assert len(operator.open) == 1
        pages[1].choose("Robot", "right")
        wait_until(lambda: bool(second.subscribed) and not operator.open)
        pages[1].press_stop()
        assert first.stops
        assert second.stops
    finally:
        for page in pages:
            page.close()
        viewer.close()


def test_one_robot_leaves_no_choice(serve: Callable[..., ViewServer]) -> None:
    page = PageClient(serve().url)
    wait_until(lambda: "lift the" in page.text)
    assert "Robot" not in page.labels
    page.close()
