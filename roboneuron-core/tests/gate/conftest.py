"""Tests of the limiter share arms with hand-computed numbers, in `gantry.py` and `planar.py`; tests
of the latch share observers.
"""

from __future__ import annotations

import os

import pytest

from roboneuron.gate import AuditLog, AuditRecord


@pytest.fixture
def records(audit: AuditLog) -> list[AuditRecord]:
    """Records of the audit."""
    seen: list[AuditRecord] = []
    audit.on_record = seen.append
    return seen


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files and directories synced to disk."""
    seen: list[str] = []
    monkeypatch.setattr(
        os, "fsync", lambda descriptor: seen.append(os.readlink(f"/proc/self/fd/{descriptor}"))
    )
    return seen
