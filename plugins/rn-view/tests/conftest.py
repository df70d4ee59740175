"""A view in this process, and a real browser that looks at it."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from view_fakes import FakeOperator, FakeSource, admission

from rn_view.options import ViewOptions
from rn_view.web.view_server import ViewServer

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
)
PATIENCE_MS = 60_000
"""A page draws with the processor here, which others use too."""


@pytest.fixture
def source() -> FakeSource:
    """What the page shows."""
    return FakeSource()


@pytest.fixture
def operator() -> FakeOperator:
    """What the buttons do."""
    return FakeOperator()


@pytest.fixture
def serve(source: FakeSource, operator: FakeOperator) -> Iterator[Callable[..., ViewServer]]:
    """Return a function that serves the page, with tokens if any are given."""
    viewers: list[ViewServer] = []

    def start(*tokens: tuple[str, str], **options: Any) -> ViewServer:
        chosen = ViewOptions(enabled=True, port=0, **options)
        viewer = ViewServer(chosen, source, admission(chosen, *tokens), operator)
        viewers.append(viewer)
        viewer.open()
        return viewer

    yield start
    for viewer in viewers:
        viewer.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium of this machine. Module scope: playwright keeps an event loop in this
    thread.
    """
    if importlib.util.find_spec("playwright") is None:
        pytest.skip("playwright is not installed: pip install playwright")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on this machine: apt-get install chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def look(browser: Any) -> Iterator[Callable[..., Any]]:
    """Return a function that opens a page; the page is small, so that it renders quickly."""
    contexts: list[Any] = []

    def open_page(url: str, first: str = "EMERGENCY STOP") -> Any:
        context = browser.new_context(viewport={"width": 700, "height": 500})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.goto(url)
        page.get_by_text(first).first.wait_for()
        return page

    yield open_page
    for context in contexts:
        context.close()
