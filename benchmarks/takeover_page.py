"""A page with a scripted operator, in its own process so that it can be stopped or killed. It reads
requests as lines of JSON from its stdin and writes answers to its stdout.

    python benchmarks/takeover_page.py URL FILE [--browser CHROMIUM]

It writes the time of the newest sample to FILE [ns since 1970, int64]. With a browser the operator
holds Space and keys; without one the samples are sent to the websocket as the page would send them.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "plugins" / "rn-view" / "tests"))

PERIOD_S = 0.02
ANSWER_S = 60.0
PATIENCE_MS = 30_000.0
FLAGS = ("--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader")
KEYS = (("KeyW", "KeyS"), ("KeyA", "KeyD"), ("KeyR", "KeyF"))


class PageProcess:
    """Handle of the page's process in the benchmark."""

    def __init__(self, url: str, folder: Path, browser: str = "") -> None:
        self._stamp = folder / f"sample-{time.monotonic_ns()}"
        self._stamp.write_bytes(bytes(8))
        command = [sys.executable, __file__, url, str(self._stamp)]
        command += ["--browser", browser] if browser else []
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._answers: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()
        self._is_ready = False

    def ready(self) -> None:
        """Wait until the page is open. Raises RuntimeError when it does not open."""
        if not self._is_ready:
            self.answer()
            self._is_ready = True

    def do(self, what: str, **facts: Any) -> dict[str, Any]:
        """Send a request and wait for the answer. Raises RuntimeError when the process has
        ended.
        """
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": what, **facts}) + "\n")
        self.process.stdin.flush()
        return self.answer()

    def answer(self) -> dict[str, Any]:
        """The next answer; RuntimeError when none comes within ANSWER_S."""
        try:
            answer = self._answers.get(timeout=ANSWER_S)
        except queue.Empty:
            answer = {"ended": True}
        if "ended" in answer:
            raise RuntimeError("The page's process does not answer.")
        return answer

    def sampled_ns(self) -> int:
        """Time at which the newest sample was sent [ns since 1970]."""
        return int.from_bytes(self._stamp.read_bytes(), "little")

    def end(self) -> None:
        """Kill the process; idempotent."""
        self.process.kill()
        self.process.wait(timeout=10.0)
        self._stamp.unlink(missing_ok=True)

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._answers.put(json.loads(line))
        self._answers.put({"ended": True})


class SocketPerson:
    """Sends samples at 50 Hz, as the page's script does during teleoperation."""

    def __init__(self, url: str, sampled: Callable[[], object]) -> None:
        from lead_client import LeadPage

        self._page = LeadPage(url)
        self._sampled = sampled
        self._wish: tuple[list[float], bool] = ([0.0] * 6, False)
        self._stopped = threading.Event()
        self._sending = threading.Lock()
        threading.Thread(target=self._send, daemon=True).start()

    def lead(self, mode: str, scale: float) -> str:
        """Request the arm; returns the reason of a refusal, or ""."""
        return self._page.lead(mode, scale)

    def drive(self, twist: list[float], held: bool) -> None:
        """Set the twist and the dead-man switch from now on; the first sample is sent at once."""
        with self._sending:
            self._wish = twist, held
            self._one()

    def back(self) -> str:
        """Hand back; returns the reason of a refusal, or ""."""
        return self._page.ask({"back": 1})

    def close(self) -> None:
        """Close the page's websocket."""
        self._stopped.set()
        with self._sending:
            self._page.socket.close()

    def _send(self) -> None:
        due_s = time.monotonic()
        while not self._stopped.is_set():
            with self._sending:
                if self._page.is_led and not self._stopped.is_set():
                    self._one()
            due_s = max(due_s + PERIOD_S, time.monotonic())
            time.sleep(max(0.0, due_s - time.monotonic()))

    def _one(self) -> None:
        twist, held = self._wish
        self._page.send(twist, held=held)
        self._sampled()


class BrowserPerson:
    """Presses buttons and keys of the page in a headless Chromium."""

    def __init__(self, url: str, browser: str, sampled: Callable[[], object]) -> None:
        from playwright.sync_api import sync_playwright

        self._sampled = sampled
        self._playwright = sync_playwright().start()
        chromium = self._playwright.chromium.launch(executable_path=browser, args=list(FLAGS))
        self._page = chromium.new_page(viewport={"width": 700, "height": 500})
        self._page.set_default_timeout(PATIENCE_MS)
        self._page.goto(url)
        self._page.locator("#rn-lead-open").click()
        self._down: set[str] = set()

    def lead(self, mode: str, scale: float) -> str:
        """See SocketPerson."""
        page, button = self._page, "#rn-lead-go" if mode == "person" else "#rn-lead-blend"
        page.locator("#rn-lead-scale").fill(str(round(scale * 10) * 10))
        for _ in range(2):
            page.locator(f"{button}:enabled").click()
            either = page.locator("#rn-lead-back:visible, #rn-lead-state.bad:visible").first
            either.wait_for(timeout=PATIENCE_MS)
            if page.locator("#rn-lead-back").is_visible():
                return ""
            page.locator("#rn-lead-operate").click()
            page.get_by_text("You are the operator now").wait_for(timeout=PATIENCE_MS)
        return str(page.locator("#rn-lead-state").inner_text())

    def drive(self, twist: list[float], held: bool) -> None:
        """See SocketPerson; keys give only the direction, not the magnitude."""
        wanted = {"Space"} if held else set()
        for value, (more, less) in zip(twist[:3], KEYS, strict=True):
            if value:
                wanted.add(more if value > 0 else less)
        for key in sorted(self._down - wanted, key=lambda key: key != "Space"):
            self._page.keyboard.up(key)
        for key in sorted(wanted - self._down):
            self._page.keyboard.down(key)
        self._down = wanted
        self._sampled()

    def back(self) -> str:
        """See SocketPerson."""
        self._page.locator("#rn-lead-back").click()
        self._page.locator("#rn-lead-go").wait_for(state="visible", timeout=PATIENCE_MS)
        text = str(self._page.locator("#rn-lead-state").inner_text())
        return "" if text == "Handed back." else text

    def close(self) -> None:
        """Close the page."""
        self._page.close()


def main() -> int:
    """Serve requests until the input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("stamp", type=Path)
    parser.add_argument("--browser", default="")
    arguments = parser.parse_args()
    stamp = os.open(arguments.stamp, os.O_WRONLY)

    def sampled() -> None:
        os.pwrite(stamp, time.time_ns().to_bytes(8, "little"), 0)

    person: SocketPerson | BrowserPerson = (
        BrowserPerson(arguments.url, arguments.browser, sampled)
        if arguments.browser
        else SocketPerson(arguments.url, sampled)
    )
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        what, text, begun_ns = asked.pop("do"), "", time.time_ns()
        if what == "lead":
            text = person.lead(**asked)
        elif what == "drive":
            person.drive(**asked)
        elif what == "back":
            text = person.back()
        else:
            person.close()
        told = {"text": text, "begun_ns": begun_ns, "done_ns": time.time_ns()}
        print(json.dumps(told), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
