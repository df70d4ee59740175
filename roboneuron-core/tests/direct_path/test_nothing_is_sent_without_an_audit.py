"""What happens to motion when the audit cannot be written."""

from __future__ import annotations

from pathlib import Path

import pytest

from roboneuron.errors import RefusedError
from roboneuron.gate import AuditLog

FORWARD = {"linear": {"x": 0.2}}


@pytest.fixture
def full_disk(tmp_path: Path, clock) -> AuditLog:
    """An audit on a device that is always full."""
    (tmp_path / "full").symlink_to("/dev/full")
    return AuditLog(tmp_path / "full", clock.wall_ns)


def test_motion_is_refused_while_it_cannot_be_written(make_gate, ask, endpoints, full_disk) -> None:
    gate = make_gate(audit=full_disk)
    gate.check_running()
    with pytest.raises(RefusedError, match=r"audit .* cannot be written"):
        gate.check(ask(endpoints["velocity"], FORWARD))
    with pytest.raises(RefusedError, match="Nothing moves without it"):
        gate.check_running()
    assert gate.check(ask(endpoints["scan"])).may_send
    with pytest.raises(RefusedError, match=r"linear\.x"):
        gate.check(ask(endpoints["velocity"], {"linear": {"x": 5}}))
    gate.latch.latch(who="a", reason="still works", audit=full_disk)
    assert gate.latch.is_latched()


def test_motion_goes_on_when_it_can_be_written_again(
    make_gate, ask, endpoints, tmp_path: Path, clock
) -> None:
    blocked = tmp_path / "blocked"
    blocked.touch()
    gate = make_gate(audit=AuditLog(blocked / "audit", clock.wall_ns))
    with pytest.raises(RefusedError):
        gate.check(ask(endpoints["velocity"], FORWARD))
    blocked.unlink()
    assert gate.check(ask(endpoints["velocity"], FORWARD)).may_send
    gate.check_running()
