"""Count what lies on a way through the code: functions, files, and visits of files.

A recorder notes the calls of the project's functions on every thread, in order. Of these, `Way`
keeps the calls on the threads that carry the way, one thread after the other, and counts:

- functions: different ones;
- files: different ones;
- visits: runs of successive calls within one file, as a reader who follows the calls turns pages;
- returns: visits to a file that was visited before, which is visits less files.

Comprehensions are no functions; a coroutine or generator counts when it is created, and not when it
is resumed.
"""

from __future__ import annotations

import inspect
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from types import CodeType, FrameType

_RESUMED = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR


@dataclass(frozen=True, slots=True)
class Call:
    """A call: when [monotonic ns], on which thread, below which outermost function of the project,
    and which function of which file.
    """

    at_ns: int
    thread: str
    root: str
    file: str
    function: str


@dataclass(frozen=True, slots=True)
class Way:
    """The calls of a way, in order."""

    calls: Sequence[Call]

    @property
    def functions(self) -> int:
        """Number of different functions."""
        return len({(call.file, call.function) for call in self.calls})

    @property
    def files(self) -> list[str]:
        """The files in the order of their first call."""
        return list(dict.fromkeys(call.file for call in self.calls))

    @property
    def visits(self) -> list[tuple[str, list[str]]]:
        """Successive files, each with the functions called in it."""
        runs = groupby(self.calls, key=lambda call: call.file)
        return [(file, [call.function for call in calls]) for file, calls in runs]

    def counts(self) -> dict[str, int]:
        """The counts by name."""
        visits, files = len(self.visits), len(self.files)
        return {
            "functions": self.functions,
            "files": files,
            "visits": visits,
            "returns": visits - files,
        }

    def told(self) -> str:
        """The counts in words."""
        return ", ".join(f"{count} {name}" for name, count in self.counts().items())

    def listing(self) -> str:
        """The visits, one a line."""
        return "\n".join(f"    {file}: {', '.join(names)}" for file, names in self.visits)


@dataclass
class Recorder:
    """Notes the calls of the project's functions while it is started.

    Attributes:
        is_on: whether calls are noted.
        calls: the noted calls, in order; of all threads that began after `install`, and the one
            that called it.
    """

    is_on: bool = False
    calls: list[Call] = field(default_factory=list)
    _names: dict[CodeType, str] = field(default_factory=dict)

    def install(self) -> None:
        """Watch this thread and every later one."""
        threading.setprofile(self._note)
        sys.setprofile(self._note)

    def remove(self) -> None:
        """Watch no more."""
        threading.setprofile(None)
        sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, argument: object) -> None:
        if event != "call" or not self.is_on:
            return
        code = frame.f_code
        name = self._names.get(code)
        if name is None:
            name = self._names[code] = file_of(code)
        if not name or (code.co_flags & _RESUMED and not _begins(frame)):
            return
        thread = threading.current_thread().name
        root = self._root_of(frame)
        self.keep(Call(time.monotonic_ns(), thread, root, name, code.co_qualname))

    def keep(self, call: Call) -> None:
        """Note a call."""
        self.calls.append(call)

    def _root_of(self, frame: FrameType) -> str:
        root, at = frame.f_code.co_qualname, frame.f_back
        while at is not None and self._names.get(at.f_code):
            root, at = at.f_code.co_qualname, at.f_back
        return root


def _begins(frame: FrameType) -> bool:
    """True at the first entry of a coroutine or generator, False where it is resumed."""
    # the argument of RESUME. Source: Python, module dis, since 3.11
    return frame.f_code.co_code[frame.f_lasti + 1] == 0


def file_of(code: CodeType) -> str:
    """The file of a function, from its package on; empty for one that is not of the project."""
    if code.co_name.startswith("<") and code.co_name != "<lambda>":
        return ""
    path = code.co_filename
    for mark in ("/src/roboneuron/", "/src/rn_"):
        place = path.rfind(mark)
        if place >= 0:
            return path[place + len("/src/") :]
    return ""
