"""The steps of a framework's client, each told on a line of JSON; standard library only."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time
from collections.abc import Awaitable, Callable, Mapping

STEPS = ("list", "call", "image", "error", "progress", "cancel")
URL = sys.argv[1] if len(sys.argv) > 1 else ""
TOKEN = os.environ.get("TEST_TOKEN", "")
HEADERS = {"Authorization": f"Bearer {TOKEN}"}
"""All clients of a script are one operator."""
DRIVE = {"message": {"linear": {"x": 0.1}}, "duration_s": 30}
ASK = {**DRIVE, "dry_run": True}
UNKNOWN = {"type": "no_such_msgs/msg/Nothing"}
"""Arguments of `describe_interface` that are refused."""
START = {"controller": "urdf"}
DRIVEN_S, FREE_S = 1.5, 15.0
Text = Callable[[str, dict[str, object]], Awaitable[str]]
"""Calls a tool; returns its answer as text, however the framework shows it."""


class SkippedError(Exception):
    """The framework offers no such thing; the text says what."""


def tell(step: str, is_good: bool, said: str) -> None:
    """Print the outcome of a step."""
    print(json.dumps({"step": step, "good": is_good, "said": said[:200]}), flush=True)


async def go(steps: Mapping[str, Callable[[], Awaitable[str]]]) -> None:
    """Run all steps in order; a step that fails does not end the others."""
    for name in STEPS:
        try:
            tell(name, True, await asyncio.wait_for(steps[name](), 120))
        except SkippedError as error:
            tell(name, True, f"not offered: {error}")
        except Exception as error:  # every framework has its own
            tell(name, False, f"{type(error).__name__}: {error}")


def expect(is_so: object, said: str) -> str:
    """Return what was said; raise AssertionError unless it is so."""
    if not is_so:
        raise AssertionError(said[:300])
    return said[:60].replace("\n", " ")


async def error_of(text: Text) -> str:
    """A failed call shows its reason, as an answer or as the framework's exception."""
    try:
        said = await text("describe_interface", dict(UNKNOWN))
    except Exception as error:  # every framework has its own
        said = f"{type(error).__name__}: {error}"
    return expect("no_such_msgs" in said, said)


async def cancelled(call: Callable[[], Awaitable[object]], leave: Callable[[], Awaitable[object]],
                    text: Text) -> str:  # fmt: skip
    """A drive that is cancelled ends: at once, or when its client leaves."""
    driving = asyncio.ensure_future(call())
    await asyncio.sleep(DRIVEN_S)
    if driving.done():
        return expect(False, f"it did not drive: {driving.exception() or driving.result()}")
    driving.cancel()
    await asyncio.wait([driving], timeout=5)
    await leave()
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < FREE_S:
        said = await text("publish_velocity", dict(ASK))
        if '"allowed": true' in said or "'allowed': True" in said or '"allowed":true' in said:
            return f"free {time.monotonic() - begun_s:.1f} s after"
        await asyncio.sleep(0.2)
    return expect(False, f"it drives on: {said}")
