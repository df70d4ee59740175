"""A twin that is killed or frozen ends its preview by what it is, before the time is over."""

from __future__ import annotations

import sys
import time

import pytest

from rn_standard.simulate import twin_process
from rn_standard.simulate.twin_process import TwinProcess
from roboneuron import DriverSpec, NotReadyError, RobotProfile

WAYS = {
    "frozen": ("import os, signal; os.kill(os.getpid(), signal.SIGSTOP)", "is frozen"),
    "ended": ("import sys; sys.exit(3)", "has ended"),
    "silent": ("import time; time.sleep(60)", "did not answer in time"),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_twin_that_is_lost_is_named(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    program, told = WAYS[way]
    monkeypatch.setattr(twin_process, "COMMAND", (sys.executable, "-S", "-c", program))
    spec = DriverSpec(name="none", summary="None.", target="nowhere:Driver", simulated=True)
    left_s = 0.5 if way == "silent" else 100.0
    with pytest.raises(NotReadyError, match=told):
        TwinProcess(spec, {}, RobotProfile(name="gantry"), time.monotonic() + left_s)
