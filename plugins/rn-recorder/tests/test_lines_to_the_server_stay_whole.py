"""The pipe from the recorder to its server."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import BinaryIO

import pytest

from rn_recorder_runs.line_pipe import MOST_BYTES, LinePipe, parse_line

PRINTS = """
import os, subprocess, sys, threading
from rn_recorder_runs.line_pipe import LinePipe, own_stdout
pipe = LinePipe(own_stdout())
def chatter():
    for _ in range(300):
        print("a plugin")
        os.write(1, b"a library")
threads = [threading.Thread(target=chatter) for _ in range(3)]
for thread in threads:
    thread.start()
for number in range(300):
    pipe.write({"re": number})
for thread in threads:
    thread.join()
subprocess.run(["echo", "a child"])
"""


@pytest.fixture
def ends() -> Iterator[tuple[BinaryIO, LinePipe]]:
    read, write = os.pipe()
    with os.fdopen(read, "rb") as reader, os.fdopen(write, "wb"):
        yield reader, LinePipe(write)


def test_a_line_that_a_full_pipe_took_in_parts_is_whole(ends: tuple[BinaryIO, LinePipe]) -> None:
    reader, pipe = ends
    long = {"status": "x" * 150_000}  # more than a pipe takes
    for line in (long, {"re": 1}):
        pipe.write(line)
    read = os.read(reader.fileno(), 2**20)
    assert b"\n" not in read
    for line in ({"re": 2}, {"re": 3}, {"re": 4}):
        pipe.write(line)
        read += os.read(reader.fileno(), 2**20)
    assert [parse_line(line) for line in read.splitlines()] == [
        long,
        *({"re": number} for number in (1, 2, 3, 4)),
    ]


def test_a_line_without_room_is_logged_as_lost(
    ends: tuple[BinaryIO, LinePipe], caplog: pytest.LogCaptureFixture
) -> None:
    _, pipe = ends
    for _ in range(4):
        pipe.write({"status": "x" * MOST_BYTES})
        pipe.write({"re": 7})
    assert "is lost" in caplog.text
    assert len(caplog.text) < 4000


def test_a_server_that_has_ended_is_no_fault() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb"):
        LinePipe(write).write({"re": 1})


def test_nothing_that_is_printed_comes_between_the_lines() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PRINTS], capture_output=True, check=True, timeout=60
    )
    assert [json.loads(line) for line in done.stdout.splitlines()] == [
        {"re": number} for number in range(300)
    ]
    assert b"a child" in done.stderr
