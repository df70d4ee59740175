"""The audit's lines byte by byte, the size at which it rotates, its lock, and the handling of its
descriptor.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from roboneuron import RefusedError, log_files
from roboneuron.gate import AuditLog, AuditRecord

TIME_NS = 1_700_000_000_123_456_789
"""2023-11-14 22:13:20.123 UTC."""
RECORD = AuditRecord(who="ann", role="viewer", tool="t", verdict="allowed")
LINE = (
    b'{"time":"2023-11-14T22:13:20.123+00:00","time_ns":1700000000123456789,'
    b'"who":"ann","role":"viewer","tool":"t","verdict":"allowed"}\n'
)
MOST_BYTES = 10_000_000


def a_log(path: Path, **settings: int) -> AuditLog:
    return AuditLog(path, lambda: TIME_NS, **settings)


def written(arguments: dict[Any, Any], path: Path) -> Any:
    """The arguments as written in the audit."""
    a_log(path).write(
        AuditRecord(who="ann", role="viewer", tool="t", verdict="allowed", arguments=arguments)
    )
    return json.loads(path.read_text())["arguments"]


def handles(path: Path) -> list[int]:
    """This process's descriptors of a file and of its rotated copies."""
    names = ((int(entry), f"/proc/self/fd/{entry}") for entry in os.listdir("/proc/self/fd"))
    return [
        number
        for number, name in names
        if os.path.lexists(name) and os.readlink(name).startswith(str(path))
    ]


def fill(path: Path, size_bytes: int) -> None:
    """Create a sparse file of that size that ends with a whole line."""
    with path.open("wb") as file:
        file.seek(size_bytes - 1)
        file.write(b"\n")


@contextmanager
def standard_input_closed() -> Iterator[None]:
    """As in a service started without standard input: the next file gets descriptor 0."""
    kept = os.dup(0)
    os.close(0)
    try:
        yield
    finally:
        os.dup2(kept, 0)
        os.close(kept)


def test_a_line_is_compact_json_in_the_order_of_the_record(tmp_path: Path) -> None:
    a_log(tmp_path / "a").write(RECORD)
    assert (tmp_path / "a").read_bytes() == LINE


def test_a_line_tells_every_field_that_is_not_empty(tmp_path: Path) -> None:
    a_log(tmp_path / "a").write(
        AuditRecord(
            who="Jürgen",
            role="operator",
            tool="move_ee",
            verdict="scaled",
            robot="left",
            endpoint="arm",
            rule="speed",
            reason="too fast",
            arguments={"x": 1, "y": [0.5, None]},
            clamped=("x: 1 -> 0.5",),
        )
    )
    assert (tmp_path / "a").read_bytes() == (
        b'{"time":"2023-11-14T22:13:20.123+00:00","time_ns":1700000000123456789,'
        b'"who":"J\\u00fcrgen","role":"operator","tool":"move_ee","verdict":"scaled","robot":"left","endpoint":"arm",'
        b'"rule":"speed","reason":"too fast","arguments":{"x":1,"y":[0.5,null]},"clamped":["x: 1 '
        b'-> 0.5"]}\n'
    )


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"x": object(), "y": {1}}, {"x": "<object>", "y": [1]}),
        ({"x": b"\xff"}, {"unwritable": "PydanticSerializationError"}),
        (
            {"x": float("nan"), "y": [float("inf"), -float("inf")]},
            {"x": "NaN", "y": ["Infinity", "-Infinity"]},
        ),
        ({"x": "\ud800"}, {"unwritable": "PydanticSerializationError"}),
        ({"x": "\u00fc\u2603", "y": 1e16}, {"x": "\u00fc\u2603", "y": 1e16}),
    ],
    ids=["no JSON type", "no text", "no JSON number", "half a character", "not ASCII"],
)
def test_arguments_that_json_does_not_know_are_named(
    tmp_path: Path, arguments: dict, told: dict
) -> None:
    assert written(arguments, tmp_path / "a") == told


def test_arguments_that_hold_themselves_are_named(tmp_path: Path) -> None:
    arguments: dict[str, Any] = {}
    arguments["x"] = arguments
    assert written(arguments, tmp_path / "a") == {"unwritable": "PydanticSerializationError"}


def test_arguments_of_4096_characters_are_kept_and_longer_ones_cut_there(tmp_path: Path) -> None:
    around = len('{"x":"","z":1}')
    kept = {"x": "y" * (4096 - around), "z": 1}
    longer = {"x": "y" * (4097 - around), "z": 1}
    assert written(kept, tmp_path / "a") == kept
    begins = '{"x":"' + "y" * (4097 - around) + '","z":1'
    assert written(longer, tmp_path / "b") == {"length": 4097, "begins": begins}


def test_only_arguments_are_cut(tmp_path: Path) -> None:
    """Other fields are bounded by the writer of a record."""
    reason, arguments = "y" * 5000, {"x": [1.5, "z"]}
    record = AuditRecord(who="ann", role="viewer", tool="t", verdict="refused", reason=reason)
    log = a_log(tmp_path / "a")
    log.write(record)
    log.write(replace(record, arguments=arguments))
    bare, full = map(json.loads, (tmp_path / "a").read_text().splitlines())
    assert bare["reason"] == full["reason"] == reason
    assert "arguments" not in bare
    assert full["arguments"] == arguments


def test_a_nan_in_arguments_of_4096_characters_is_no_number_of_the_line(tmp_path: Path) -> None:
    """As text it is longer, so the end is cut."""
    count = 4096 - len('{"n":NaN,"x":""}')
    assert written({"n": float("nan"), "x": "y" * count}, tmp_path / "a") == {
        "length": 4098,
        "begins": '{"n":"NaN","x":"' + "y" * count,
    }


def test_the_file_is_for_its_owner_and_group_and_so_is_the_lock(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        log = a_log(tmp_path / "state" / "a", max_bytes=len(LINE))
        log.write(RECORD)
        log.write(RECORD)
    finally:
        os.umask(before)
    modes = {
        path.name: stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "state").iterdir()
    }
    assert modes == {"a": 0o640, "a.1": 0o640, "a.lock": 0o640}
    assert stat.S_IMODE((tmp_path / "state").stat().st_mode) == 0o750


@pytest.mark.parametrize("settings", [{}, {"max_bytes": 1000}], ids=["10 MB", "1 kB"])
@pytest.mark.parametrize("more_bytes", [-1, 0, 1])
def test_a_file_is_filled_to_its_last_byte_and_rotated_beyond(
    tmp_path: Path, settings, more_bytes: int
) -> None:
    path = tmp_path / "a"
    size = settings.get("max_bytes", MOST_BYTES) - len(LINE) + more_bytes
    fill(path, size)
    a_log(path, **settings).write(RECORD)
    if more_bytes > 0:
        assert sorted(os.listdir(tmp_path)) == ["a", "a.1", "a.lock"]
        assert ((tmp_path / "a.1").stat().st_size, path.read_bytes()) == (size, LINE)
    else:
        assert os.listdir(tmp_path) == ["a"]
        assert path.stat().st_size == size + len(LINE)


@pytest.mark.parametrize(
    ("settings", "kept"),
    [({"backups": 0}, 1), ({"backups": 1}, 1), ({"backups": 2}, 2), ({}, 5)],
    ids=["none asked for", "1", "2", "default"],
)
def test_rotated_files_are_numbered_from_the_newest_on(tmp_path: Path, settings, kept: int) -> None:
    log = AuditLog(tmp_path / "a", lambda: TIME_NS, max_bytes=len(LINE), **settings)
    for number in range(9):  # one file each
        log.write(AuditRecord(who="ann", role="viewer", tool=str(number), verdict="allowed"))
    files = ["a", *(f"a.{number}" for number in range(1, kept + 1))]
    assert sorted(os.listdir(tmp_path)) == sorted([*files, "a.lock"])
    tools = [json.loads((tmp_path / name).read_text())["tool"] for name in files]
    assert tools == [str(8 - place) for place in range(kept + 1)]


def is_locked(path: Path) -> bool:
    """True if another process could not rotate now."""
    with path.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_nobody_else_can_rotate_while_the_files_are_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename, locked = Path.replace, []

    def replace(self: Path, target: Path) -> Path:
        locked.append(is_locked(tmp_path / "a.lock"))
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    log = a_log(tmp_path / "a", max_bytes=len(LINE), backups=2)
    for _ in range(3):
        log.write(RECORD)
    assert locked == [True] * 3  # a -> .1, then .1 -> .2 and a -> .1
    assert not is_locked(tmp_path / "a.lock")


@pytest.mark.timeout(20)
def test_a_process_that_keeps_the_lock_is_not_waited_for_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that freezes during a rotation: nothing moves, and the caller gets an error."""
    monkeypatch.setattr(log_files, "LOCK_S", 0.1)
    log = a_log(tmp_path / "a", max_bytes=len(LINE))
    log.write(RECORD)
    with (tmp_path / "a.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RefusedError, match=r"cannot be written: another process has kept"):
            log.write(RECORD)
    log.write(RECORD)
    assert sorted(os.listdir(tmp_path)) == ["a", "a.1", "a.lock"]


def rotate_and_fill(path: Path, size_bytes: int) -> None:
    path.rename(path.with_name("a.1"))
    fill(path, size_bytes)


def rotate_only(path: Path, _: int) -> None:
    path.rename(path.with_name("a.1"))


@pytest.mark.parametrize(
    ("by_the_other", "size_bytes", "files"),
    [
        (rotate_and_fill, 1000 - len(LINE), ["a", "a.1", "a.lock"]),
        (rotate_and_fill, 1001 - len(LINE), ["a", "a.1", "a.2", "a.lock"]),
        (rotate_only, 0, ["a", "a.1", "a.lock"]),
    ],
    ids=["just fits", "full again", "not begun"],
)
def test_who_waited_for_the_lock_looks_again_before_it_rotates(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    by_the_other: Callable[[Path, int], None],
    size_bytes: int,
    files: list[str],
) -> None:
    path, lock = tmp_path / "a", fcntl.flock
    fill(path, 1000)

    def flock_after_the_other(descriptor: int, operation: int) -> None:
        by_the_other(path, size_bytes)
        lock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", flock_after_the_other)
    a_log(path, max_bytes=1000).write(RECORD)
    assert sorted(os.listdir(tmp_path)) == files
    assert path.read_bytes().endswith(LINE)
    assert (tmp_path / files[-2]).stat().st_size == 1000, "what was full is the oldest"


@pytest.mark.parametrize(
    ("there", "is_cut"),
    [(b"", False), (b"\n", False), (b"{}\n", False), (b"{", True), (b"{}\n{", True)],
    ids=["empty", "an end", "a line", "a character", "a line and a character"],
)
def test_only_a_line_without_an_end_is_called_cut(
    tmp_path: Path, there: bytes, is_cut: bool
) -> None:
    path = tmp_path / "a"
    path.write_bytes(there)
    log = a_log(path)
    log.write(RECORD)
    log.write(RECORD)
    came = path.read_bytes().removeprefix(there)
    if is_cut:
        end, mark, came = came[:1], *came[1:].split(b"\n", 1)
        assert end == b"\n"
        assert json.loads(mark)["verdict"] == "cut"
    assert came == 2 * LINE


def test_a_part_of_a_record_is_left_where_another_process_has_written_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, write = tmp_path / "a", os.write
    log = a_log(path)
    log.write(RECORD)

    def write_a_part(descriptor: int, line: bytes) -> int:
        done = write(descriptor, line[:20])
        with path.open("ab") as other:
            other.write(b"another's\n")
        return done

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write_a_part)
        with pytest.raises(RefusedError, match="only a part") as refused:
            log.write(RECORD)
    assert isinstance(refused.value.__cause__, OSError)
    assert refused.value.__cause__.errno == errno.ENOSPC
    assert path.read_bytes() == LINE + LINE[:20] + b"another's\n"


def test_who_listens_hears_of_records_that_are_written_and_of_no_others(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    log, heard = a_log(tmp_path / "a" / "b"), []
    log.on_record = heard.append
    (tmp_path / "a" / "b").mkdir()  # blocks the file
    assert log.failure is None
    with pytest.raises(RefusedError):
        log.write(RECORD)
    assert log.failure is not None
    assert heard == []
    (tmp_path / "a" / "b").rmdir()
    log.write(RECORD)
    assert (log.failure, heard) == (None, [RECORD])


def test_one_descriptor_is_held_however_often_the_file_changes(tmp_path: Path) -> None:
    path = tmp_path / "a"
    log = a_log(path, max_bytes=len(LINE), backups=1)
    for _ in range(3):  # rotated by itself
        log.write(RECORD)
        assert len(handles(path)) == 1
    path.rename(tmp_path / "a.1")  # by another process
    log.write(RECORD)
    assert len(handles(path)) == 1
    path.unlink()
    log.write(RECORD)
    assert len(handles(path)) == 1
    log.close()
    assert handles(path) == []


def test_descriptor_zero_is_one_like_any_other(tmp_path: Path) -> None:
    path = tmp_path / "a"
    log = a_log(path)
    with standard_input_closed():
        log.write(RECORD)
        log.write(RECORD)
        held = handles(path)
        log.close()
        left = handles(path)
    assert (held, left) == ([0], [])
    assert path.read_bytes() == 2 * LINE


def test_closing_what_was_never_opened_closes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "close", lambda descriptor: pytest.fail(f"closed {descriptor}"))
        a_log(tmp_path / "a").close()


def test_a_descriptor_that_was_closed_by_mistake_costs_one_record(tmp_path: Path) -> None:
    """As by a library that closes all descriptors: the audit opens its file again."""
    path = tmp_path / "a"
    log = a_log(path)
    log.write(RECORD)
    os.close(*handles(path))
    with pytest.raises(RefusedError, match="Nothing moves without it"):
        log.write(RECORD)
    log.write(RECORD)
    assert path.read_bytes() == 2 * LINE
