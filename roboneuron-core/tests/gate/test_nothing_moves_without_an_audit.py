"""The audit: whole lines, rotation, several writers."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from roboneuron import RefusedError
from roboneuron.gate import AuditLog, AuditRecord

WRITE = """
import sys, time
from pathlib import Path
from roboneuron.gate import AuditLog, AuditRecord
log = AuditLog(Path(sys.argv[1]), time.time_ns, max_bytes=4_000, backups=40)
for i in range(300):
    log.write(AuditRecord(who=sys.argv[2], role="operator", tool=str(i), verdict="allowed"))
"""


def record(**changes) -> AuditRecord:
    return AuditRecord(
        **{"who": "a", "role": "viewer", "tool": "t", "verdict": "allowed", **changes}
    )


def read(*paths: Path) -> list[dict]:
    return [
        json.loads(line, parse_constant=pytest.fail)
        for p in paths
        for line in p.read_text().splitlines()
    ]


def test_a_line_holds_time_and_all_that_is_known(audit, clock) -> None:
    audit.write(record(arguments={"x": 1}, endpoint="e"))
    (line,) = read(audit.path)
    assert line == {
        "time": "2023-11-14T22:13:20.000+00:00",
        "time_ns": clock.start_ns + 1,
        "who": "a",
        "role": "viewer",
        "tool": "t",
        "endpoint": "e",
        "verdict": "allowed",
        "arguments": {"x": 1},
    }


def deep() -> list:
    value: list = []
    for _ in range(100_000):
        value = [value]
    return value


@pytest.mark.parametrize(
    "arguments",
    [
        {"x": float("nan")},
        {"x": b"bytes"},
        {"x": {1, 2}},
        {(1, 2): 3},
        {"x": "y" * 1_000_000},
        {"x": "\ud800\n\x00"},
        {"x": deep()},
    ],
    ids=["nan", "bytes", "set", "tuple key", "megabyte", "odd text", "deep"],
)
def test_whatever_an_agent_sends_is_one_short_line(audit, arguments) -> None:
    audit.write(record(arguments=arguments))
    audit.write(record())
    assert len(read(audit.path)) == 2
    assert audit.path.stat().st_size < 20_000


def test_it_rotates_by_size_and_keeps_so_many(tmp_path: Path, clock) -> None:
    log = AuditLog(tmp_path / "a", clock.wall_ns, max_bytes=1000, backups=2)
    for i in range(100):
        log.write(record(tool=str(i)))
    files = [tmp_path / name for name in ("a.2", "a.1", "a")]
    assert all(file.stat().st_size <= 1000 for file in files)
    assert not (tmp_path / "a.3").exists()
    numbers = [int(line["tool"]) for line in read(*files)]
    assert numbers == list(range(numbers[0], 100))


def test_several_processes_and_threads_lose_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a"
    children = [
        subprocess.Popen([sys.executable, "-c", WRITE, str(path), who]) for who in ("p", "q")
    ]
    log = AuditLog(path, lambda: 1, max_bytes=4_000, backups=40)
    threads = [
        threading.Thread(
            target=lambda n=n: [log.write(record(who=f"t{n}", tool=str(i))) for i in range(100)]
        )
        for n in (0, 1)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [child.wait(timeout=60) for child in children] == [0, 0]
    lines = read(*(p for p in tmp_path.iterdir() if not p.name.endswith(".lock")))
    assert sorted((line["who"], int(line["tool"])) for line in lines) == sorted(
        [(who, i) for who in ("p", "q") for i in range(300)]
        + [(who, i) for who in ("t0", "t1") for i in range(100)]
    )


def test_a_deleted_file_is_begun_again(audit) -> None:
    audit.write(record())
    audit.path.unlink()
    audit.write(record(tool="second"))
    assert read(audit.path)[0]["tool"] == "second"


@contextmanager
def room_for(size_bytes: int) -> Iterator[None]:
    """Limit the file size of this process, as on a full disk: the last write is short."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_no_cut_line(audit) -> None:
    audit.write(record(tool="before"))
    whole = audit.path.stat().st_size
    with room_for(whole + 40):
        for _ in range(2):
            with pytest.raises(RefusedError, match="Nothing moves without it"):
                audit.write(record(tool="cut"))
            assert audit.failure is not None
    assert audit.path.stat().st_size == whole
    audit.write(record(tool="after"))
    assert [line["tool"] for line in read(audit.path)] == ["before", "after"]


def test_a_line_that_somebody_left_cut_is_ended_and_told(audit) -> None:
    """As after a power failure: the next writer, in any process, does not append to it."""
    audit.write(record(tool="before"))
    audit.close()
    with audit.path.open("ab") as file:
        file.write(b'{"time":"2023-11-')
    audit.write(record(tool="after"))
    audit.write(record(tool="last"))
    before, cut, *rest = audit.path.read_text().splitlines()
    assert json.loads(before)["tool"] == "before"
    assert cut == '{"time":"2023-11-'
    mark, after, last = (json.loads(line) for line in rest)
    assert (mark["verdict"], mark["rule"]) == ("cut", "audit")
    assert "cut short" in mark["reason"]
    assert (after["tool"], last["tool"]) == ("after", "last")
