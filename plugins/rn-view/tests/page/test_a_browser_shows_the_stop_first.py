"""The stop above the page in a real browser: large, never covered, by the keyboard, and with enough
contrast.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from view_fakes import FakeOperator, FakeSource, admission
from view_page import UNLABELLED, wait_until

from rn_view.options import ViewOptions
from rn_view.web.view_server import ViewServer

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.filterwarnings("default:Queued a:UserWarning"),
]
SIZES = ((1440, 860), (768, 1024), (390, 844))
CONTRAST = """button => {
  const light = text => {
    const [red, green, blue] = text.match(/[\\d.]+/g).slice(0, 3).map(value => value / 255)
      .map(value => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const style = getComputedStyle(button), pair = [light(style.color), light(style.backgroundColor)].sort();
  return (Math.max(...pair) + 0.05) / (Math.min(...pair) + 0.05);
}"""  # noqa: E501
"""Source: WCAG 2.2, "relative luminance" and "contrast ratio"."""
ON_TOP = """button => {
  const box = button.getBoundingClientRect(), free = (x, y) => button.contains(document.elementFromPoint(x, y));
  return [0.02, 0.25, 0.5, 0.75, 0.98].every(share =>
    [0.1, 0.5, 0.9].every(part => free(box.x + share * box.width, box.y + part * box.height)));
}"""  # noqa: E501
SCENE = """() => {
  const canvas = [...document.querySelectorAll('canvas')].sort((a, b) => b.clientWidth - a.clientWidth)[0];
  const box = canvas.getBoundingClientRect(), around = canvas.parentElement.parentElement.parentElement;
  const panels = '.mantine-Paper-root, .mantine-ScrollArea-root, .mantine-Tabs-root, .mantine-Notification-root';
  let seen = 0;
  for (let x = 2; x < innerWidth; x += 4) {
    const hit = document.elementFromPoint(x, box.y + 0.4 * box.height);
    seen += around.contains(hit) && !hit.closest(panels);
  }
  return seen * 4;
}"""  # noqa: E501
"""Width [px] in which the scene is not covered."""


@pytest.fixture
def sized(browser: Any) -> Iterator[Callable[..., Any]]:
    """Return a function that opens a page of a given width and height."""
    contexts: list[Any] = []

    def open_page(url: str, size: tuple[int, int]) -> Any:
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(90_000)
        page.goto(url)
        return page

    yield open_page
    for context in contexts:
        context.close()


@pytest.mark.parametrize("size", SIZES, ids=[f"{width}px" for width, _ in SIZES])
def test_the_stop_is_large_and_on_top_at_every_width(
    serve: Callable[..., ViewServer], sized: Callable[..., Any], size: tuple[int, int]
) -> None:
    page = sized(serve().url, size)
    button = page.get_by_role("button", name="EMERGENCY STOP")
    page.locator("#rn-lead-open").wait_for()
    page.locator("#webgl-software-rendering").wait_for(state="attached")
    box = button.bounding_box()
    assert box["height"] >= 60
    assert box["width"] >= 0.5 * size[0]
    assert box["y"] < 20
    assert button.evaluate(ON_TOP)
    assert button.evaluate(CONTRAST) >= 4.5
    # The panels find their place after the first frames, which take long on a busy machine.
    wait_until(lambda: page.evaluate(SCENE) >= min(300, size[0] - 30))
    assert page.evaluate(UNLABELLED) == []
    assert page.title() == "twolink - RoboNeuron"


SHOWN = """state => {
  const inside = state.parentElement.getBoundingClientRect(), all = document.createRange();
  all.selectNodeContents(state);
  const text = all.getBoundingClientRect();
  return text.left >= 0 && text.right <= innerWidth && text.top >= 0 && text.bottom <= inside.bottom
    && inside.bottom <= innerHeight;
}"""
"""Whether the whole text is within its bar, and the bar within the page."""


@pytest.mark.parametrize("size", SIZES, ids=[f"{width}px" for width, _ in SIZES])
def test_the_whole_command_that_releases_it_is_legible_and_names_the_machine(
    serve: Callable[..., ViewServer],
    sized: Callable[..., Any],
    source: FakeSource,
    size: tuple[int, int],
) -> None:
    page = sized(serve().url, size)
    page.get_by_role("button", name="EMERGENCY STOP").click()
    assert source.stopped.wait(60)
    page.get_by_text(source.release_command).wait_for()
    state = page.locator("#rn-state")
    assert socket.gethostname() in state.inner_text()
    assert state.evaluate(SHOWN)
    assert page.get_by_role("button", name="EMERGENCY STOP").evaluate(ON_TOP)


BELOW = """() => {
  const edge = (id, side) => document.getElementById(id).getBoundingClientRect()[side];
  return Math.abs(edge("rn-strip", "top") - edge("rn-bar", "bottom")) < 1
    && Math.abs(edge("rn-main", "top") - edge("rn-strip", "bottom")) < 1;
}"""
"""Whether strip and page begin where what is above them ends. Heights are fractions of pixels."""


@pytest.mark.parametrize("size", SIZES, ids=[f"{width}px" for width, _ in SIZES])
def test_neither_bar_covers_what_is_below(
    serve: Callable[..., ViewServer], sized: Callable[..., Any], size: tuple[int, int]
) -> None:
    page = sized(serve().url, size)
    page.locator("#rn-lead-open").wait_for()
    lead = page.get_by_role("button", name="Lead by hand")
    lead.wait_for()
    assert lead.evaluate(ON_TOP)
    assert page.evaluate(BELOW)
    page.get_by_role("button", name="EMERGENCY STOP").click()
    page.locator("#rn-bar.latched").wait_for()
    wait_until(lambda: page.evaluate(BELOW))
    assert lead.evaluate(ON_TOP)


def test_the_key_presses_it_from_a_field_too(
    serve: Callable[..., ViewServer], sized: Callable[..., Any], source: FakeSource
) -> None:
    page = sized(serve().url, (768, 600))
    page.get_by_role("textbox", name="Instruction").fill("wave")
    page.keyboard.press("F9")
    assert source.stopped.wait(60)
    page.locator("#rn-bar.latched").wait_for()
    assert page.get_by_role("button", name="EMERGENCY STOP").evaluate(CONTRAST) >= 4.5
    assert source.stops[0].startswith("local HTTP client view")


def test_it_is_the_first_control_and_works_without_a_websocket(
    serve: Callable[..., ViewServer], sized: Callable[..., Any], source: FakeSource
) -> None:
    viewer = serve()
    page = sized("about:blank", (600, 500))
    page.route_web_socket("**/*", lambda socket: socket.close())
    page.goto(viewer.url)
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "rn-stop"
    page.keyboard.press("Enter")
    assert source.stopped.wait(60)


def test_of_two_robots_each_has_a_stop_beside_the_one_of_all(sized: Callable[..., Any]) -> None:
    sources = {"left": FakeSource(), "right": FakeSource()}
    options = ViewOptions(enabled=True, port=0)
    viewer = ViewServer(options, sources, admission(options), FakeOperator())
    viewer.open()
    try:
        page = sized(viewer.url, (768, 600))
        page.get_by_role("button", name="Stop right").click()
        assert sources["right"].stopped.wait(60)
        assert not sources["left"].stops
        page.get_by_role("button", name="EMERGENCY STOP, ALL").click()
        assert sources["left"].stopped.wait(60)
        wait_until(lambda: len(sources["right"].stops) == 2)
        assert page.title() == "left, right - RoboNeuron"
    finally:
        viewer.close()
