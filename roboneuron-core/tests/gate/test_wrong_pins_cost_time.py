"""The PIN's file, its length, the cost of wrong ones, and the records, with reduced parameters."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import stat
import threading
from pathlib import Path
from typing import Any

import pytest

from roboneuron import log_files
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog, AuditRecord

NOW_S = 1000.0
NAME = "emergency_stop.pin"
PIN, SALT = "4711-ruby", bytes(range(16))


def quick_hash(pin: bytes, *, salt: bytes, **_: int) -> bytes:
    """Replaces scrypt, which is slow."""
    return hashlib.sha512(salt + pin).digest()


@pytest.fixture
def pin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ReleasePin:
    """A PIN that was set long ago, with a stopped clock."""
    monkeypatch.setattr(hashlib, "scrypt", quick_hash)
    made = ReleasePin(tmp_path, lambda: NOW_S)
    write(made, hash=quick_hash(PIN.encode(), salt=SALT).hex())
    return made


@pytest.fixture
def audit(tmp_path: Path) -> AuditLog:
    return AuditLog(tmp_path / "audit", lambda: 1)


def write(pin: ReleasePin, **changes: Any) -> None:
    known = {"salt": SALT.hex(), "hash": "", "failures": 0, "not_before_s": 0.0}
    if pin.path.exists():
        known = read(pin)
    pin.path.write_text(json.dumps({**known, **changes}))


def read(pin: ReleasePin) -> dict[str, Any]:
    return json.loads(pin.path.read_text())


def test_the_file_holds_the_documented_hash_and_a_salt_of_its_own(tmp_path: Path) -> None:
    pin = ReleasePin(tmp_path / "state" / "here")
    pin.set(PIN)
    known = read(pin)
    salt = bytes.fromhex(known["salt"])
    assert len(salt) == 16
    cost = {"n": 32768, "r": 8, "p": 1, "maxmem": 2**26, "dklen": 64}  # as documented
    right = hashlib.scrypt(PIN.encode(), salt=salt, **cost).hex()
    assert known == {"salt": salt.hex(), "hash": right, "failures": 0, "not_before_s": 0.0}
    assert stat.S_IMODE(pin.path.parent.stat().st_mode) == 0o750
    pin.set(PIN)
    assert read(pin)["salt"] != known["salt"]


@pytest.mark.parametrize(
    ("folder", "path"),
    [
        ("state", f"state/{NAME}"),
        ("state/robots/left", f"state/{NAME}"),
        ("robots/left/x", f"robots/left/x/{NAME}"),
    ],
)
def test_robots_of_a_fleet_share_a_pin_and_nobody_else_does(
    tmp_path: Path, folder: str, path: str
) -> None:
    assert ReleasePin(tmp_path / folder).path == tmp_path / path


@pytest.mark.parametrize("length", [4, 64])
def test_a_pin_has_4_to_64_characters(pin: ReleasePin, length: int, audit: AuditLog) -> None:
    for wrong in (3, 65):
        with pytest.raises(InvalidInputError, match=f"{wrong} characters; 4 to 64"):
            pin.set("7" * wrong)
    pin.check(PIN, who="ann", audit=audit)
    pin.set("7" * length)
    pin.check("7" * length, who="ann", audit=audit)


def test_a_pin_is_removed_and_removing_none_is_no_failure(pin: ReleasePin) -> None:
    assert pin.is_set
    for _ in range(2):
        pin.set("")
        assert not pin.is_set


def test_what_is_left_of_a_write_that_was_killed_is_in_nobodys_way(
    pin: ReleasePin, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("kept")
    (tmp_path / f".{NAME}.{os.getpid()}-{threading.get_ident()}").symlink_to(elsewhere)
    pin.set("abcdef")
    assert elsewhere.read_text() == "kept"
    assert sorted(os.listdir(tmp_path)) == ["elsewhere", NAME]
    assert not pin.path.is_symlink()


def test_a_pin_replaces_the_one_before_when_all_of_it_is_on_the_disk(
    pin: ReleasePin, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, seen = pin.path.read_text(), []

    def sync(descriptor: int) -> None:
        written = Path(os.readlink(f"/proc/self/fd/{descriptor}")).read_text()
        seen.append((written, pin.path.read_text()))

    monkeypatch.setattr(os, "fsync", sync)
    pin.set("abcdef")
    assert seen == [(pin.path.read_text(), before)]


@pytest.mark.parametrize(
    ("attempt", "delay_s"),
    [(1, 0.0), (3, 0.0), (4, 2.0), (5, 4.0), (6, 8.0), (11, 256.0), (12, 300.0), (5000, 300.0)],
)
def test_each_wrong_pin_after_the_third_doubles_the_wait_up_to_five_minutes(
    pin: ReleasePin, audit: AuditLog, attempt: int, delay_s: float
) -> None:
    write(pin, failures=attempt - 1)
    before = read(pin)
    with pytest.raises(RefusedError, match=rf"wrong \(attempt {attempt} "):
        pin.check("1234", who="agent", audit=audit)
    assert read(pin) == {**before, "failures": attempt, "not_before_s": NOW_S + delay_s}


@pytest.mark.parametrize("wait_s", [0.25, 1.0, 300.0])
def test_nothing_is_looked_at_while_an_attempt_has_to_wait(
    pin: ReleasePin, audit: AuditLog, wait_s: float
) -> None:
    write(pin, failures=7, not_before_s=NOW_S + wait_s)
    before = read(pin)
    with pytest.raises(RefusedError, match="after 7 wrong PINs"):
        pin.check(PIN, who="ann", audit=audit)
    assert read(pin) == before


@pytest.mark.parametrize("wait_s", [-0.25, 0.0, 300.25, 1e9])
def test_the_right_pin_is_taken_after_the_wait_or_when_the_clock_was_put_back(
    pin: ReleasePin, audit: AuditLog, wait_s: float
) -> None:
    """No wait is longer than five minutes; a longer one would come from a changed clock."""
    write(pin, failures=7, not_before_s=NOW_S + wait_s)
    before = read(pin)
    pin.check(PIN, who="ann", audit=audit)
    assert read(pin) == {**before, "failures": 0, "not_before_s": 0.0}


@pytest.mark.parametrize(
    ("typed", "word"), [("", "missing"), ("4711-rub", "wrong"), ("4711-ruby ", "wrong")]
)
def test_a_refusal_is_recorded_with_who_tried_and_why(
    pin: ReleasePin, audit: AuditLog, typed: str, word: str
) -> None:
    records: list[AuditRecord] = []
    audit.on_record = records.append
    with pytest.raises(RefusedError) as refused:
        pin.check(typed, who="w" * 201, audit=audit)
    reason = f"the PIN is {word} (attempt 1 since the last right one)."
    assert refused.value.message == f"The emergency stop stays latched: {reason}"
    assert records == [
        AuditRecord(
            who="w" * 200,
            role="",
            tool="reset_emergency_stop",
            verdict="refused",
            rule="pin",
            reason=reason,
        )
    ]


def test_the_right_pin_is_not_recorded_and_a_wrong_one_is_refused_without_a_record_too(
    pin: ReleasePin, audit: AuditLog
) -> None:
    pin.check(PIN, who="ann", audit=audit)
    assert not audit.path.exists()
    nowhere = AuditLog(Path("/proc/nothing/audit"), lambda: 1)
    with pytest.raises(RefusedError, match="stays latched"):
        pin.check("1234", who="agent", audit=nowhere)


@pytest.mark.parametrize(
    "changes",
    [
        {"salt": "no hex"},
        {"salt": 5},
        {"failures": "x"},
        {"failures": float("inf")},
        {"not_before_s": None},
    ],
    ids=[
        "salt of letters",
        "salt of a number",
        "failures of letters",
        "endless failures",
        "no time",
    ],
)
def test_a_damaged_file_releases_nothing_and_is_left_as_it_is(
    pin: ReleasePin, audit: AuditLog, changes: dict
) -> None:
    write(pin, **changes)
    before = pin.path.read_bytes()
    with pytest.raises(RefusedError, match="cannot be read"):
        pin.check(PIN, who="ann", audit=audit)
    assert pin.path.read_bytes() == before


@pytest.mark.parametrize(
    "content",
    [b"", b"[]", b"{}", b"\xff", b"[" * 100_000],
    ids=["empty", "list", "object", "no text", "deep"],
)
def test_whatever_the_file_holds_a_pin_is_asked_for(
    pin: ReleasePin, audit: AuditLog, content: bytes
) -> None:
    pin.path.write_bytes(content)
    assert pin.is_set
    with pytest.raises(RefusedError, match="cannot be read"):
        pin.check("", who="ann", audit=audit)


def test_a_link_to_nowhere_is_a_pin_that_nobody_knows(tmp_path: Path, audit: AuditLog) -> None:
    pin = ReleasePin(tmp_path)
    pin.path.symlink_to("nowhere")
    assert pin.is_set
    with pytest.raises(RefusedError, match="cannot be read"):
        pin.check(PIN, who="ann", audit=audit)


@pytest.mark.timeout(20)
def test_a_process_that_keeps_the_lock_refuses_the_release(
    pin: ReleasePin, audit: AuditLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_files, "LOCK_S", 0.1)
    with pin.path.with_name(f"{NAME}.lock").open("a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(RefusedError, match="another process has kept"):
            pin.check(PIN, who="ann", audit=audit)
    pin.check(PIN, who="ann", audit=audit)


def test_one_attempt_at_a_time_is_looked_at(
    pin: ReleasePin, audit: AuditLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Concurrent attempts would each read the same number of failures, and count as one."""
    lock, held = pin.path.with_name(f"{NAME}.lock"), []

    def is_locked() -> bool:
        with lock.open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False

    def look(pin: bytes, *, salt: bytes, **cost: int) -> bytes:
        held.append(is_locked())
        return quick_hash(pin, salt=salt)

    monkeypatch.setattr(hashlib, "scrypt", look)
    pin.check(PIN, who="ann", audit=audit)
    assert held == [True]
    assert not is_locked()
