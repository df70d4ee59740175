"""What a killed process leaves in shared-memory ports: locks are released, its own port swallows what comes."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy

from roboneuron.ros.dead_ports import SilentPorts, release_dead_locks
from roboneuron.ros.port_record import IN_USE, IS_OK, LISTENER, LOCKS, WAITING, find_record, lock_owner
from roboneuron.ros.segments import LOCK_SUFFIX, PORT_PREFIX, SHARED_MEMORY, owned_segments

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


def test_port_of_the_dead_swallows_what_comes_until_it_is_retired(name: str, tmp_path: Path) -> None:
    port = int(name.removeprefix(PORT_PREFIX))
    copy = tmp_path / name
    copy.write_bytes((SHARED_MEMORY / name).read_bytes())  # its owner is as if it had died just now
    lock = tmp_path / f"{name}{LOCK_SUFFIX}"
    lock.touch()
    before = find_record(copy.read_bytes(), port)
    assert before is not None
    assert before.flags & IS_OK
    with lock.open("rb") as owner:
        fcntl.flock(owner, fcntl.LOCK_EX)
        SilentPorts([name], tmp_path).retire()
        assert find_record(copy.read_bytes(), port) == before, "somebody has it"
    ports = SilentPorts([name, "fastrtps_0123456789abcdef", "fastrtps_port1"], tmp_path)
    content = copy.read_bytes()
    assert content[before.offset + LISTENER] == IN_USE, "neither waiting nor at work: nobody finds that it stands still"
    assert content[before.offset + WAITING : before.offset + WAITING + 4] == bytes(4), "nobody wakes it"
    assert find_record(content, port) == before, "nobody closes it"
    ports.retire()
    after = find_record(copy.read_bytes(), port)
    assert after is not None
    assert after.flags == before.flags & ~IS_OK
    ports.retire()


def test_files_that_are_no_ports_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "fastrtps_port7411").write_bytes(b"")
    (tmp_path / "fastrtps_port7413").write_bytes(b"port_node_abi5" + bytes(30_000))
    (tmp_path / "fastrtps_port7415_el").touch()
    assert release_dead_locks(directory=tmp_path) == 0
    assert release_dead_locks(["fastrtps_port7"], tmp_path) == 0
