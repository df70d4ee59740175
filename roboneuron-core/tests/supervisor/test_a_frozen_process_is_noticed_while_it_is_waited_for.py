"""If a module is frozen while a call waits for it, the wait ends at once, not at its timeout."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

import pytest

from rn_testing.fakes import fake_plan
from roboneuron.config import Config
from roboneuron.errors import NotReadyError
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
START_S = 40.0
SOON_S = 15.0
"""Half a second on an idle machine; what matters is that nothing waits for the start's timeout."""
MakeConfig = Callable[..., Config]


def freeze(supervisor: Supervisor) -> int:
    process = supervisor.slot("robot").process
    assert process is not None
    os.kill(process.pid, signal.SIGSTOP)
    return process.pid


def test_a_start_ends_when_its_process_is_frozen(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    def freeze_when_configuring(stage: str) -> None:
        if stage == "robot: configuring":
            freeze(supervisor)

    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match=r"frozen .* while configuring"):
        supervisor.start(
            fake_plan("robot", make_config(START_S, robot="slow-configure")),
            on_stage=freeze_when_configuring,
        )
    assert time.monotonic() - started_s < SOON_S
    assert supervisor.view("robot").phase == "stopped"


def test_a_process_that_is_stopped_for_a_moment_is_waited_for(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    def stop_for_a_moment(stage: str) -> None:
        if stage == "robot: configuring":
            pid = freeze(supervisor)
            threading.Timer(0.1, os.kill, [pid, signal.SIGCONT]).start()

    assert (
        supervisor.start(fake_plan("robot", make_config(START_S)), on_stage=stop_for_a_moment).phase
        == "running"
    )
