"""Take the screenshots of docs/view.md: a server with the simulated FR3, a client that calls its
tools, and a browser.

    .venv/bin/python tools/view_screenshots.py    # into docs/assets; one to two minutes

Nothing is staged: the screenshots show what a person would see, the calls are those of the client,
and the last one plays the recording made meanwhile. Each is taken when the page shows the required
state; if one fails, none is replaced. A machine that renders the page on its processor shows lower
rates than others.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Literal

import anyio
from mcp import Client
from playwright.async_api import Browser, Page, TimeoutError, async_playwright

from rn_recorder_runs.store import RunStore
from rn_standard.console.client import spawned_server
from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenTable
from rn_testing.domain import free_ros_domain
from rn_view.options import ViewOptions
from rn_view.web.access import ViewAccess, host_rules
from rn_view.web.view_server import ViewServer
from rn_view_recorded.source import RecordedSource
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover

INSTRUCTION, SEED = "pick up the red cube", 7
CONFIG = f"""
[robot]
name = "fr3"
driver = "simulated"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[supervisor]
state_directory = "{{state}}"
[recorder]
record = true
[view]
enabled = true
port = 0
[plugins.fr3]
seed = {SEED}
[plugins.fr3-sim-camera]
width = 320
height = 320
"""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WIDE, TABLET, PHONE = (1440, 900), (820, 1180), (390, 844)
QUALITY = 72
MOST_S = 180.0
WORKS = ("lifting", "holding")
"""Reports of the policy in the live screenshots; the second one persists."""
RECORDED = "descending"
"""Report of the policy in the screenshot of the recording."""
SHOWS = """words => {
  const text = document.body.textContent;
  const pictures = [...document.querySelectorAll('img')].filter(image => /^(blob|data):/.test(image.src));
  const pen = Object.assign(document.createElement('canvas'), {width: 8, height: 8}).getContext('2d');
  const isDrawn = picture => {
    if (!picture.complete || !picture.naturalWidth) return false;
    pen.drawImage(picture, 0, 0, 8, 8);
    const pixels = pen.getImageData(0, 0, 8, 8).data;
    return pixels.some((value, index) => index % 4 < 3 && Math.abs(value - pixels[index % 4]) > 8);
  };
  return words.some(word => text.includes(word)) && pictures.length > 1 && pictures.slice(0, 2).every(isDrawn);
}"""  # noqa: E501
"""True if the page shows one of the words and both camera images have more than one colour."""
FRAMES = """() => new Promise(done => {
  let left = 10;
  const next = () => (left-- ? requestAnimationFrame(next) : done());
  next();
})"""


async def look(
    browser: Browser, url: str, size: tuple[int, int], scheme: Literal["light", "dark"] = "light"
) -> Page:
    """Open the page."""
    page = await browser.new_page(
        viewport={"width": size[0], "height": size[1]}, color_scheme=scheme
    )
    page.set_default_timeout(MOST_S * 1e3)
    await page.goto(url)
    await page.get_by_text("Instruction:").wait_for()
    return page


async def close_notice(page: Page) -> None:
    """Close the browser's notice that it has no graphics card."""
    notice = page.locator(".mantine-Notification-closeButton")
    with suppress(TimeoutError):
        await notice.first.click(force=True, timeout=10_000)


async def shoot(page: Page, path: Path, words: tuple[str, ...]) -> None:
    """Take a screenshot when the page shows one of the words."""
    await page.wait_for_function(SHOWS, arg=list(words), polling=100)
    await close_notice(page)
    await page.evaluate(FRAMES)  # until the notice has faded and the current scene is drawn
    await anyio.sleep(0.7)
    await page.screenshot(path=path, type="jpeg", quality=QUALITY)
    print(path.name, flush=True)


@asynccontextmanager
async def served(state: Path) -> AsyncIterator[tuple[Client, str]]:
    """A server with the view, and the URL of its page."""
    config, log = state / "roboneuron.toml", state / "server.log"
    config.write_text(CONFIG.format(state=state), encoding="utf-8")
    async with spawned_server(["--config", str(config)], log) as client:
        with anyio.fail_after(MOST_S):
            while not (
                found := re.findall(r"live view is at (\S+:\d+)", log.read_text(encoding="utf-8"))
            ):
                await anyio.sleep(0.1)
        yield client, found[0]


async def live(folder: Path, state: Path, browser: Browser) -> None:
    """Make an agent's calls, and take screenshots at three sizes, by day and by night."""
    async with served(state) as (client, url):

        async def call(tool: str, **arguments: Any) -> None:
            answer = await client.call_tool(tool, arguments)
            if answer.is_error:
                raise SystemExit(f"{tool} failed: {answer.content}")
            print(tool, flush=True)

        wide = await look(browser, url, WIDE)
        for kind in ("robot", "perception", "control"):
            await call(f"start_{kind}")
        await call("start_inference", instruction=INSTRUCTION)
        await shoot(wide, folder / "view-live.jpg", WORKS)
        await wide.close()  # two pages are too much for a machine that draws with its processor
        await shoot_one(browser, url, WIDE, "dark", folder / "view-live-night.jpg")
        for name, size in (("tablet", TABLET), ("phone", PHONE)):
            await shoot_one(browser, url, size, "light", folder / f"view-{name}.jpg")
            await shoot_one(browser, url, size, "dark", folder / f"view-{name}-night.jpg")
        await call("stop_all")


async def shoot_one(
    browser: Browser, url: str, size: tuple[int, int], scheme: Literal["light", "dark"], path: Path
) -> None:
    """Take a screenshot of a new page. The layout for phones keeps the camera images in a section
    that is closed at first.
    """
    page = await look(browser, url, size, scheme)
    await page.wait_for_function(
        "word => document.body.textContent.includes(word)", arg=WORKS[1], polling=100
    )
    await close_notice(page)
    await anyio.sleep(4.0)  # the joints come
    await page.screenshot(path=path, type="jpeg", quality=QUALITY)
    await page.close()
    print(path.name, flush=True)


async def recorded(folder: Path, state: Path, browser: Browser) -> None:
    """Take the screenshot of the recording."""
    store = RunStore(state / "runs")
    run = next(run for run in store.runs() if run.kind == "recording")
    source = RecordedSource(run.id, run.files, load_config(None), discover())
    options = ViewOptions(port=0)
    viewer = ViewServer(
        options,
        source,
        ViewAccess(tokens=TokenTable([]), rules=host_rules(options, HttpOptions())),
        None,
    )
    viewer.open()
    source.open()
    try:
        page = await look(browser, viewer.url, WIDE)
        source.playback.seek(await moment(source))
        await shoot(page, folder / "view-recording.jpg", (RECORDED,))
        await page.close()
    finally:
        source.close()
        viewer.close()


async def moment(source: RecordedSource) -> float:
    """Time at which the policy has given the report for half a second; a page must be open."""
    at_s = next(
        mark.at_s for mark in source.playback.marks if mark.text.startswith("start_inference")
    )
    while at_s < source.playback.duration_s:
        at_s += 0.1
        source.playback.seek(at_s)
        await anyio.sleep(0.15)  # delivered 30 times a second
        if any(RECORDED in row.text for row in source.snapshot().modules):
            return at_s + 0.5
    raise SystemExit(f"The policy never said {RECORDED!r}.")


async def main(target: Path) -> None:
    """Take all three screenshots."""
    os.environ.update(ROS_DOMAIN_ID=str(free_ros_domain()), ROBONEURON_RECORDER="on")
    with tempfile.TemporaryDirectory() as name:
        folder, state = Path(name) / "pictures", Path(name) / "state"
        folder.mkdir()
        state.mkdir()
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(
                executable_path=shutil.which("chromium"), args=FLAGS
            )
            await live(folder, state, browser)
            await recorded(folder, state, browser)
            await browser.close()
        for picture in sorted(folder.iterdir()):
            shutil.copyfile(picture, target / picture.name)
            print(target / picture.name, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(__file__).parents[1] / "docs" / "assets"
    )
    sys.exit(anyio.run(main, parser.parse_args().folder))
