"""An interpreter on a file system that does not answer blocks no caller forever."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_until
from roboneuron.config import Config
from roboneuron.errors import NotReadyError
from roboneuron.supervisor import supervisor as supervisor_module
from roboneuron.supervisor.process import ModuleProcess, spawn
from roboneuron.supervisor.supervisor import Supervisor


@pytest.mark.timeout(60)
def test_a_process_that_comes_too_late_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    came: list[ModuleProcess] = []

    def spawn_late(*arguments: object) -> ModuleProcess:
        assert answers.wait(30.0)
        came.append(spawn(*arguments))  # type: ignore[arg-type]
        return came[0]

    monkeypatch.setattr(supervisor_module, "spawn", spawn_late)
    supervisor = Supervisor(tmp_path, command=lambda python: ["/bin/sh", "-c", "sleep 60"])
    config = Config.model_validate(
        {"robot": {"name": "gantry"}, "supervisor": {"start_timeout_s": 0.2}}
    )
    try:
        with pytest.raises(NotReadyError, match=r"robot process was not started within 0\.2 s"):
            supervisor.start(fake_plan("robot", config))
        assert supervisor.slot("robot").phase == "stopped"
    finally:
        answers.set()
        supervisor.close()
    wait_until(lambda: came and came[0].exit_code is not None, 10.0, "the late process is ended")
