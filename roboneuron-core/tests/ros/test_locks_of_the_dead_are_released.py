"""A lock in a shared-memory port whose holder was killed is released; one that somebody holds is not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy

from roboneuron.ros.dead_locks import release_dead_locks
from roboneuron.ros.port_record import LOCKS, find_record, lock_owner
from roboneuron.ros.segments import PORT_PREFIX, SHARED_MEMORY, owned_segments

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


@pytest.fixture
def name() -> Iterator[str]:
    """A port that nobody else knows."""
    before = owned_segments(os.getpid())
    context = rclpy.Context()
    context.init()
    node = rclpy.create_node("owner", context=context)
    yield max(name for name in owned_segments(os.getpid()) - before if name.startswith(PORT_PREFIX))
    node.destroy_node()
    context.shutdown()


def owners(name: str) -> list[int]:
    content = (SHARED_MEMORY / name).read_bytes()
    record = find_record(content, int(name.removeprefix(PORT_PREFIX)))
    assert record is not None
    return [lock_owner(content, record.offset + lock) for lock in LOCKS]


def hold(name: str) -> subprocess.Popen[str]:
    path = SHARED_MEMORY / name
    record = find_record(path.read_bytes(), int(name.removeprefix(PORT_PREFIX)))
    assert record is not None
    offsets = [str(record.offset + lock) for lock in LOCKS]
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), *offsets], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_only_locks_of_the_dead_are_released(name: str) -> None:
    holder = hold(name)
    try:
        assert owners(name) == [holder.pid, holder.pid]
        assert release_dead_locks([name]) == 0, "it lives"
        assert owners(name) == [holder.pid, holder.pid]
    finally:
        holder.kill()
        holder.communicate()
    assert owners(name) == [holder.pid, holder.pid], "a lock outlives its holder"
    assert release_dead_locks([name]) == 2
    assert holder.pid not in owners(name)
    assert release_dead_locks([name]) == 0


def test_files_that_are_no_ports_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7411").write_bytes(b"")
    (tmp_path / "fastrtps_port7413").write_bytes(b"port_node_abi5" + bytes(30_000))
    (tmp_path / "fastrtps_port7415_el").touch()
    assert release_dead_locks(directory=tmp_path) == 0
    assert release_dead_locks(["fastrtps_port7"], tmp_path) == 0
