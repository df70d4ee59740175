"""Optional PIN for releasing the emergency stop, stored as a hash next to the latch.

It protects against clients that can type a command or answer a question but do not know it, such as
an agent with a shell. It does not protect against processes that can write to the state directory.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from roboneuron import foreign
from roboneuron.errors import ForeignDataError, InvalidInputError, RefusedError
from roboneuron.gate import AuditLog, AuditRecord
from roboneuron.log_files import locked

FILE_NAME = "emergency_stop.pin"
"""Name of the hash file in the state directory; a fleet has one for all its robots."""
_ROBOTS = "robots"
"""Folder of the robots of a fleet, see `roboneuron.config.robot_folder`."""
_LEAST, _MOST = 4, 64
"""Minimum and maximum length: short enough to type at a robot; delays compensate for a
short PIN.
"""
_N, _R, _P, _MEMORY = 2**15, 8, 1, 64 * 2**20
"""Cost of scrypt: about 0.1 s and 32 MiB. Source: RFC 7914."""
_FREE, _MOST_WAIT_S = 3, 300.0
"""Number of wrong PINs without a delay, and the longest delay; each further wrong PIN doubles the
delay, from 2 s on.
"""


class ReleasePin:
    """The PIN of one state directory; usable by several processes at once. Nothing is cached in
    memory, so changes and counts by other processes apply at once.
    """

    def __init__(self, folder: Path, clock_s: Callable[[], float] = time.time) -> None:
        """Args:
        folder: folder of the latch; a robot of a fleet uses the fleet's PIN.
        clock_s: wall-clock time [s], the same for all processes.
        """
        shared = folder.parent.parent / FILE_NAME
        self.path = shared if folder.parent.name == _ROBOTS else folder / FILE_NAME
        self._clock_s = clock_s

    @property
    def is_set(self) -> bool:
        """True if a release requires the PIN; also if the file cannot be read."""
        return os.path.lexists(self.path)

    def set(self, pin: str) -> None:
        """Replace the PIN, or remove it with an empty one; the caller has checked the previous one.

        Raises:
            InvalidInputError: it is too short or too long.
        """
        if not pin:
            self.path.unlink(missing_ok=True)
            return
        if not _LEAST <= len(pin) <= _MOST:
            raise InvalidInputError(
                f"The PIN has {len(pin)} characters; {_LEAST} to {_MOST} are allowed."
            )
        salt = secrets.token_bytes(16)
        self._write(
            {"salt": salt.hex(), "hash": _hash(pin, salt), "failures": 0, "not_before_s": 0.0}
        )

    def check(self, pin: str, *, who: str, audit: AuditLog) -> None:
        """Check a PIN; passes if none is set or it is correct. Attempts are counted, delayed and
        audited.

        Args:
            pin: as typed by a person.
            who: the client.
            audit: gets a record of each refusal.

        Raises:
            RefusedError: it is wrong, or the next attempt has to wait after several wrong ones.
        """
        if not self.is_set:
            return
        # one attempt at a time, so that each is counted
        try:
            with locked(self.path):
                reason = self._attempt(pin)
        except OSError as error:
            reason = f"the PIN cannot be looked at: {error.strerror or error}."
        if reason:
            record = AuditRecord(
                who=who[:200],
                role="",
                tool="reset_emergency_stop",
                verdict="refused",
                rule="pin",
                reason=reason,
            )
            audit.write_if_possible(record)
            raise RefusedError(
                f"The emergency stop stays latched: {reason}",
                hint="Ask a person who knows the PIN.",
                rule="pin",
            )

    def _attempt(self, pin: str) -> str:
        """Reason to refuse the PIN; empty if it is correct. The file's lock is held."""
        try:
            known = foreign.table(foreign.read_json(self.path), FILE_NAME)
            salt = foreign.octets(known.get("salt"), "salt")
            right = foreign.text(known.get("hash"), "hash")
            failures = foreign.integer(known.get("failures"), "failures", 0)
            wait_s = foreign.number(known.get("not_before_s"), "not_before_s") - self._clock_s()
        except (FileNotFoundError, ForeignDataError):
            return f"the file of the PIN, {self.path}, cannot be read."
        # a longer one was written before the clock was set back: it would lock people out
        if 0.0 < wait_s <= _MOST_WAIT_S:
            return f"after {failures} wrong PINs the next one is looked at in {wait_s:.0f} s."
        # in constant time, whatever part of it is correct
        if hmac.compare_digest(_hash(pin, salt), right):
            self._write({**known, "failures": 0, "not_before_s": 0.0})
            return ""
        failures += 1
        # 2 s, 4 s, 8 s ...; the exponent is bounded, because 2.0 ** 1024 is an error
        delay_s = 0.0 if failures <= _FREE else min(2.0 ** min(failures - _FREE, 16), _MOST_WAIT_S)
        self._write({**known, "failures": failures, "not_before_s": self._clock_s() + delay_s})
        return (
            f"the PIN is {'missing' if not pin else 'wrong'} (attempt {failures} since the "
            "last right one)."
        )

    def _write(self, content: dict[str, Any]) -> None:
        foreign.write_private(self.path, json.dumps(content))


def _hash(pin: str, salt: bytes) -> str:
    """scrypt hash of a PIN, in hexadecimal: slow, against guessing from the file."""
    return hashlib.scrypt(pin.encode(), salt=salt, n=_N, r=_R, p=_P, maxmem=_MEMORY).hex()
