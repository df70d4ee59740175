"""Features and commands with one fault each, and the good ones from which they derive."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from pydantic import Field

from roboneuron import CallContext, Feature, Host, NoArguments, Result, Section, Tool


class Options(Section):
    """A section."""

    unit: str = Field(default="m", description="unit of the answer")


class Needy(Section):
    """A section without defaults."""

    unit: str = Field(description="unit of the answer")


class Number(Result):
    """An answer."""

    value: int = Field(description="a number")


def make_tool(**changes: Any) -> Tool[Any]:
    """A good tool, with changes."""

    async def answer(_: NoArguments, context: CallContext) -> Number:
        return Number(value=1)

    facts: dict[str, Any] = {
        "name": "count_wheels",
        "title": "Count the wheels",
        "description": "How many wheels the robot has.",
        "arguments": NoArguments,
        "result": Number,
        "handler": answer,
        "read_only": True,
    }
    return Tool(**{**facts, **changes})


class Good(Feature[Any]):
    """Keeps every rule."""

    def tools(self, host: Host) -> list[Tool[Any]]:
        return [make_tool()]


class NoFeature:
    def __init__(self, options: object) -> None: ...


class OpensFile(Good):
    def __init__(self, options: Any) -> None:
        super().__init__(options)
        Path("/proc/version").read_text()


class Raises(Good):
    def tools(self, host: Host) -> list[Tool[Any]]:
        raise RuntimeError("no tools today")


class ClashingName(Good):
    def tools(self, host: Host) -> list[Tool[Any]]:
        return [make_tool(name="get_status")]


class CamelCase(Good):
    def tools(self, host: Host) -> list[Tool[Any]]:
        return [make_tool(name="countWheels")]


class SaysNothing(Good):
    def tools(self, host: Host) -> list[Tool[Any]]:
        return [make_tool(description="Counts.")]


class LeavesThread(Good):
    def start(self, host: Host) -> None:
        self._end = threading.Event()
        threading.Thread(target=self._end.wait, args=(30.0,), name="forgotten").start()


class StartsForEver(Good):
    def start(self, host: Host) -> None:
        threading.Event().wait(30.0)


class Prints(Good):
    def start(self, host: Host) -> None:
        print("wheels are counted")


class TakesSignals(Good):
    def tools(self, host: Host) -> list[Tool[Any]]:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        return super().tools(host)


class CloseNeedsStart(Good):
    def close(self) -> None:
        self._thread.join()  # type: ignore[attr-defined]


class GoodCommand:
    """Greets."""

    def configure(self, parser: ArgumentParser) -> None:
        parser.add_argument("--who", help="who is greeted")

    def run(self, arguments: Namespace) -> int:
        return 0


class NoRun:
    """Has no `run`."""

    def configure(self, parser: ArgumentParser) -> None: ...


class RunsAProcess(GoodCommand):
    """Starts something in its constructor."""

    def __init__(self) -> None:
        subprocess.run([sys.executable, "-c", ""], check=True)


class ReadsForHelp(GoodCommand):
    """Reads a file while it declares its arguments."""

    def configure(self, parser: ArgumentParser) -> None:
        Path("/proc/version").read_text()
        super().configure(parser)


class PrintsForHelp(GoodCommand):
    """Prints while it declares its arguments."""

    def configure(self, parser: ArgumentParser) -> None:
        print("greet!")
        super().configure(parser)


class NoHelp(GoodCommand):
    """Its argument has no help."""

    def configure(self, parser: ArgumentParser) -> None:
        parser.add_argument("--who")
