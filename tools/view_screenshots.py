"""Take the pictures of docs/view.md: a server with the simulated FR3, a client that calls its tools, and a browser.

    .venv/bin/python tools/view_screenshots.py docs/assets

Nothing is staged: the pictures show what a person would see, the calls are those of the client, and the third one plays
the recording that was made meanwhile. A machine that draws the page with its processor shows lower rates than others.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
from playwright.async_api import Browser, Page, TimeoutError, async_playwright

from rn_console.client import spawned_server
from rn_runs.store import Store
from rn_serve_http.options import HttpOptions
from rn_serve_http.tokens import TokenTable
from rn_testing.domain import free_ros_domain
from rn_view.access import Admission, host_rules
from rn_view.options import ViewOptions
from rn_view.viewer import Viewer
from rn_view_recorded.source import RecordedSource
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover

INSTRUCTION, SEED, PORT = "pick up the red cube", 7, 8781
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
port = {PORT}
[plugins.fr3]
seed = {SEED}
"""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
MOST_MS = 300_000


async def look(browser: Browser, url: str, *, width: int, height: int) -> Page:
    """Open the page and wait until it shows everything."""
    page = await browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(MOST_MS)
    await page.goto(url)
    await page.get_by_text("Instruction:").wait_for()
    return page


async def shoot(page: Page, path: Path) -> None:
    """Take a picture, without the browser's notice that it has no graphics card."""
    notice = page.locator(".mantine-Notification-closeButton")
    with suppress(TimeoutError):
        await notice.first.click(force=True, timeout=20_000)
    await anyio.sleep(2.0)  # it fades
    await page.screenshot(path=path, type="jpeg", quality=82)
    print(path, flush=True)


async def live(folder: Path, state: Path, browser: Browser) -> None:
    """An agent's calls, and two pages that look on."""
    config = state / "roboneuron.toml"
    config.write_text(CONFIG.format(state=state), encoding="utf-8")
    async with spawned_server(["--config", str(config), "--log-level", "error"], state / "server.log") as client:

        async def call(tool: str, **arguments: Any) -> dict[str, Any]:
            answer = await client.call_tool(tool, arguments)
            print(tool, "failed" if answer.is_error else "done", flush=True)
            return dict(answer.structured_content or {})

        for kind in ("robot", "perception", "control"):
            await call(f"start_{kind}")
        wide = await look(browser, f"http://127.0.0.1:{PORT}", width=1280, height=760)
        await anyio.sleep(3.0)
        await call("start_inference", instruction=INSTRUCTION)
        for _ in range(30):  # until it works as on a machine that has the time
            modules = (await call("get_status"))["modules"]
            if all(module["health"] == "ok" for module in modules):
                break
            await anyio.sleep(2.0)
        await anyio.sleep(1.0)
        await shoot(wide, folder / "view-live.jpg")
        await wide.close()
        phone = await look(browser, f"http://127.0.0.1:{PORT}", width=412, height=840)
        await anyio.sleep(4.0)
        await shoot(phone, folder / "view-phone.jpg")
        await phone.close()
        await call("stop_all")


async def recorded(folder: Path, state: Path, browser: Browser) -> None:
    """The recording of that."""
    store = Store(state / "runs")
    run = next(run for run in store.runs() if run.kind == "recording")
    source = RecordedSource(run.id, run.files, load_config(None), discover())
    options = ViewOptions(port=0)
    viewer = Viewer(options, source, Admission(tokens=TokenTable([]), rules=host_rules(options, HttpOptions())), None)
    viewer.open()
    source.open()
    try:
        page = await look(browser, viewer.url, width=1280, height=760)
        begun = next(mark for mark in source.playback.marks if mark.text.startswith("start_inference"))
        source.playback.seek(begun.at_s + 3.5)
        await anyio.sleep(8.0)
        await shoot(page, folder / "view-recording.jpg")
    finally:
        source.close()
        viewer.close()


async def main() -> None:
    """Take all three pictures."""
    os.environ.update(ROS_DOMAIN_ID=str(free_ros_domain()), ROBONEURON_RECORDER="on")
    folder = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as name:
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            await live(folder, Path(name), browser)
            await recorded(folder, Path(name), browser)
            await browser.close()


if __name__ == "__main__":
    anyio.run(main)
