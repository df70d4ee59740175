"""Take the screenshot of docs/lerobot.md: a page of the live view whose sliders a person moves, and
the terminal of the `lerobot-record` that follows them.

    .venv/bin/python tools/lerobot_picture.py       # into docs/assets; needs .venv-lerobot

Nothing is staged: the simulated SO-101 follows the sliders through lerobot, and the terminal shows
lerobot's output at that log level at the time of the screenshot. `~` stands for a temporary folder.
"""

from __future__ import annotations

import argparse
import io
import os
import pty
import re
import shutil
import sys
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

import anyio
from anyio.abc import Process
from mcp import Client
from playwright.async_api import Browser, Page, TimeoutError, async_playwright
from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text
from view_screenshots import FLAGS, FRAMES, MOST_S

from rn_standard.console.client import spawned_server
from rn_testing.domain import free_ros_domain
from roboneuron.command import environment

ROOT = Path(__file__).parents[1]
RECORD = ROOT / ".venv-lerobot" / "bin" / "lerobot-record"
SIZE, TERMINAL_PX, COLUMNS, LINES = (1180, 810), 700, 84, 40
TURN_DEG, LEVEL = "25", "INFO"
MORE = """
[view]
enabled = true
port = 0
image_hz = 3
[supervisor]
state_directory = "{state}"
"""
SWITCH = "input[type=checkbox]:visible"
"""The only switch on the page."""
_TRIES = 8
FORMAT = re.sub(r"@font-face \{\{.*?\}\}", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL).replace(
    "Fira Code", "DejaVu Sans Mono"
)


def options(url: str, folder: Path) -> list[str]:
    """Options of lerobot-record."""
    return [
        "--robot.type=roboneuron",
        "--robot.robot=so101",
        "--teleop.type=roboneuron",
        "--teleop.robot=so101",
        f"--teleop.view={url}",
        "--teleop.timeout_s=5",
        "--dataset.repo_id=me/turn",
        f"--dataset.root={folder}",
        "--dataset.single_task=turn",
        "--dataset.fps=10",
        "--dataset.num_episodes=2",
        "--dataset.episode_time_s=40",
        "--dataset.push_to_hub=false",
        "--dataset.no_stamp=true",
        "--play_sounds=false",
    ]


@asynccontextmanager
async def served(state: Path) -> AsyncIterator[tuple[Client, str]]:
    """A server with the view, and the URL of its page."""
    config, log = state / "so101.toml", state / "server.log"
    text = (ROOT / "examples" / "so101.toml").read_text(encoding="utf-8")
    config.write_text(text + MORE.format(state=state), encoding="utf-8")
    async with spawned_server(["--config", str(config)], log) as client:
        with anyio.fail_after(MOST_S):
            while not (found := re.findall(r"live view is at (\S+:\d+)", log.read_text())):
                await anyio.sleep(0.1)
        for kind in ("robot", "perception", "control"):
            answer = await client.call_tool(f"start_{kind}", {})
            if answer.is_error:
                raise SystemExit(f"start_{kind} failed: {answer.content}")
        yield client, found[0]


@asynccontextmanager
async def recording(url: str, folder: Path, told: Path) -> AsyncIterator[Process]:
    """lerobot-record in a pseudo-terminal, with its output in a file."""
    person, terminal = pty.openpty()
    variables = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONWARNINGS": "ignore"}
    variables |= {"COLUMNS": str(COLUMNS), "HF_HOME": str(folder.parent / "hf")}
    command = [str(RECORD), *options(url, folder)]
    with told.open("wb") as log:
        process = await anyio.open_process(
            command, stdin=terminal, stdout=log, stderr=log, env=variables, cwd=ROOT
        )
        try:
            yield process
        finally:
            process.terminate()
            await process.wait()
            os.close(person)
            os.close(terminal)


async def until(told: Path, words: str, process: Process) -> None:
    """Wait until lerobot has printed these words."""
    with anyio.fail_after(MOST_S):
        while words not in told.read_text(errors="replace"):
            if process.returncode is not None:
                raise SystemExit(told.read_text(errors="replace")[-2000:])
            await anyio.sleep(0.1)


async def lead(page: Page) -> None:
    """Turn the switch on, and turn the first joint; repeated, because a busy page may lose
    events.
    """
    switch = page.locator(SWITCH).first
    if not await switch.is_checked():
        await switch.dispatch_event("click")
        await anyio.sleep(0.5)
    box = page.locator("input[inputmode=decimal]").locator("visible=true").first
    with suppress(TimeoutError):  # not enabled: the page does not lead yet
        await box.fill(TURN_DEG, timeout=3_000)
        await box.press("Enter")


async def shoot(browser: Browser, url: str, state: Path) -> tuple[bytes, str]:
    """Screenshot of the page while a person leads, and lerobot's output until then."""
    page = await browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
    page.set_default_timeout(MOST_S * 1e3)
    await page.goto(url)
    # events instead of a mouse, because a page rendered by the processor is never still
    await page.get_by_text("Lead", exact=True).dispatch_event("click")
    await page.get_by_text("shoulder_pan").first.wait_for(state="attached")
    await page.locator(".mantine-Notification-closeButton").first.dispatch_event("click")
    told = state / "lerobot.log"
    async with recording(url, state / "turn", told) as process:
        await lead(page)
        await until(told, "Recording episode 0", process)
        for _ in range(_TRIES):
            await lead(page)
            await anyio.sleep(3.0)
            await page.evaluate(FRAMES)
            picture = await page.screenshot(type="png")
            if await page.locator(SWITCH).first.is_checked():
                break
        else:
            raise SystemExit("The page does not lead: the machine is too busy for it.")
        text = told.read_text(errors="replace")
    await page.close()
    return picture, text.replace(str(state), "~").replace(str(ROOT), "roboneuron")


def terminal(url: str, told: str) -> str:
    """The command and its last output lines, as SVG."""
    asked = " \\\n    ".join(
        ["lerobot-record", *options(url, Path("~/turn")), f"2>&1 | grep {LEVEL}"]
    )
    lines = [line for line in told.replace("\r", "\n").split("\n") if LEVEL in line]
    left = LINES - asked.count("\n") - 2
    shown = ["\x1b[2m...\x1b[0m", *lines[-left:]] if len(lines) > left else lines
    console = Console(record=True, width=COLUMNS, file=io.StringIO())
    prompt = f"\x1b[1;32m$\x1b[0m \x1b[1m{asked}\x1b[0m"
    console.print(Text.from_ansi("\n".join([prompt, *shown])))
    return console.export_svg(title="", code_format=FORMAT, unique_id="lerobot-record")


async def main(target: Path) -> None:
    """Take the screenshot."""
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    environment.prepare_environment()
    with tempfile.TemporaryDirectory() as name:
        state = Path(name)
        async with async_playwright() as playwright:
            browser = await playwright.chromium.launch(
                executable_path=shutil.which("chromium"), args=FLAGS
            )
            async with served(state) as (_, url):
                picture, text = await shoot(browser, url, state)
            (state / "page.png").write_bytes(picture)
            (state / "terminal.svg").write_text(terminal(url, text), encoding="utf-8")
            (state / "both.html").write_text(
                '<body style="margin:0;display:flex;align-items:flex-start;background:#292929">'
                f'<img src="page.png" width="{SIZE[0]}"><img src="terminal.svg" '
                f'width="{TERMINAL_PX}"></body>',
                encoding="utf-8",
            )
            both = await browser.new_page(
                viewport={"width": SIZE[0] + TERMINAL_PX, "height": SIZE[1]}
            )
            await both.goto((state / "both.html").as_uri())
            path = target / "lerobot-record.jpg"
            await both.screenshot(path=path, type="jpeg", quality=72)
            await browser.close()
        print(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "docs" / "assets")
    sys.exit(anyio.run(main, parser.parse_args().folder))
