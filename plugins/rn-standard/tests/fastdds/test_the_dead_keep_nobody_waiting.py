"""What a killed process leaves in shared-memory ports: locks are released, its own port swallows
what comes.
"""

from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy

from rn_standard.fastdds import processes
from rn_standard.fastdds.dead_ports import SilentPorts, release_dead_locks
from rn_standard.fastdds.port_record import (
    IN_USE,
    IS_OK,
    LISTENER,
    LOCKS,
    WAITING,
    PortRecord,
    find_record,
    lock_owner,
)
from rn_standard.fastdds.processes import ProcessCleaner
from rn_standard.fastdds.segments import LOCK_SUFFIX, PORT_PREFIX, SHARED_MEMORY, owned_segments
from rn_standard.fastdds.shared_memory import SegmentRecord

pytestmark = pytest.mark.ros
HOLDER = """
import ctypes, mmap, sys
path, offsets = sys.argv[1], sys.argv[2:]
with open(path, "r+b") as file:
    memory = mmap.mmap(file.fileno(), 0)
start = ctypes.addressof((ctypes.c_char * len(memory)).from_buffer(memory))
for offset in offsets:
    assert ctypes.CDLL(None).pthread_mutex_lock(ctypes.c_void_p(start + int(offset))) == 0
print("held", flush=True)
sys.stdin.read()
"""
"""Locks of a port, held until the process ends."""


@pytest.fixture(scope="module")
def content() -> Iterator[tuple[str, bytes]]:
    """Name and content of a port whose locks nobody holds."""
    before = owned_segments(os.getpid())
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("owner", context=context)
    name = max(
        name for name in owned_segments(os.getpid()) - before if name.startswith(PORT_PREFIX)
    )
    content = (SHARED_MEMORY / name).read_bytes()
    while any(owners(name, content)):
        content = (SHARED_MEMORY / name).read_bytes()
    yield name, content
    node.destroy_node()
    context.shutdown()


@pytest.fixture
def port(content: tuple[str, bytes], tmp_path: Path) -> Path:
    """A copy of that port, as if its owner had just died: its lock file is there, and nobody holds
    it.
    """
    path = tmp_path / content[0]
    path.write_bytes(content[1])
    path.with_name(f"{path.name}{LOCK_SUFFIX}").touch()
    return path


def record_of(name: str, content: bytes) -> PortRecord:
    record = find_record(content, int(name.removeprefix(PORT_PREFIX)))
    assert record is not None
    return record


def owners(name: str, content: bytes) -> list[int]:
    offset = record_of(name, content).offset
    return [lock_owner(content, offset + lock) for lock in LOCKS]


def hold(port: Path) -> subprocess.Popen[str]:
    offset = record_of(port.name, port.read_bytes()).offset
    command = [sys.executable, "-c", HOLDER, str(port), *(str(offset + lock) for lock in LOCKS)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_only_locks_of_the_dead_are_released(port: Path) -> None:
    holder = hold(port)
    try:
        assert owners(port.name, port.read_bytes()) == [holder.pid, holder.pid]
        assert release_dead_locks(directory=port.parent) == 0, "it lives"
        assert owners(port.name, port.read_bytes()) == [holder.pid, holder.pid]
    finally:
        holder.kill()
        holder.communicate()
    assert owners(port.name, port.read_bytes()) == [holder.pid, holder.pid], (
        "a lock outlives its holder"
    )
    assert release_dead_locks(directory=port.parent) == 2
    assert owners(port.name, port.read_bytes()) == [0, 0]
    assert release_dead_locks([port.name], port.parent) == 0
    next_holder = hold(port)
    next_holder.kill()
    next_holder.communicate()


def test_the_number_of_a_dead_holder_may_be_given_to_somebody_else(port: Path) -> None:
    """Who has not mapped the port cannot hold its locks: numbers come round within minutes on a
    busy machine.
    """
    holder = hold(port)
    holder.kill()
    holder.communicate()
    offset = record_of(port.name, port.read_bytes()).offset
    with subprocess.Popen(["sleep", "60"]) as somebody:
        with port.open("r+b") as file:
            for lock in LOCKS:
                file.seek(offset + lock + 8)
                file.write(struct.pack("<i", somebody.pid))
        assert owners(port.name, port.read_bytes()) == [somebody.pid, somebody.pid]
        released = release_dead_locks(directory=port.parent)
        somebody.kill()
    assert released == 2
    assert owners(port.name, port.read_bytes()) == [0, 0]


def test_locks_that_strangers_left_are_released_before_a_process_starts(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A process that opens such a port when it starts would hang there, and nobody looked before
    another one ended.
    """
    calls: list[str] = []
    monkeypatch.setattr(processes, "release_dead_locks", lambda: calls.append("released"))
    ProcessCleaner(SegmentRecord(tmp_path / "record")).spawning()
    assert calls == ["released"]


def test_port_of_the_dead_swallows_what_comes_until_it_is_retired(port: Path) -> None:
    before = record_of(port.name, port.read_bytes())
    assert before.flags & IS_OK
    with port.with_name(f"{port.name}{LOCK_SUFFIX}").open("rb") as owner:
        fcntl.flock(owner, fcntl.LOCK_EX)
        SilentPorts([port.name], port.parent).retire()
        assert record_of(port.name, port.read_bytes()) == before, "somebody has it"
    ports = SilentPorts([port.name, "fastrtps_0123456789abcdef", "fastrtps_port1"], port.parent)
    content = port.read_bytes()
    assert content[before.offset + LISTENER] == IN_USE, (
        "neither waiting nor at work: nobody finds that it stands still"
    )
    assert content[before.offset + WAITING : before.offset + WAITING + 4] == bytes(4), (
        "nobody wakes it"
    )
    assert record_of(port.name, content) == before, "nobody closes it"
    ports.retire()
    assert record_of(port.name, port.read_bytes()).flags == before.flags & ~IS_OK
    ports.retire()


def test_files_that_are_no_ports_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7411").write_bytes(b"")
    (tmp_path / "fastrtps_port7413").write_bytes(b"port_node_abi5" + bytes(30_000))
    (tmp_path / "fastrtps_port7415_el").touch()
    assert release_dead_locks(directory=tmp_path) == 0
    assert release_dead_locks(["fastrtps_port7"], tmp_path) == 0
