"""A module whose inputs nobody provides says so after seconds, not after the start's time-out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from roboneuron.config import Config
from roboneuron.errors import NotReadyError
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(90)]
MakeConfig = Callable[..., Config]


def test_a_backend_without_cameras_names_the_call_that_is_missing(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="not running: perception") as caught:
        supervisor.start("inference", make_config(45.0, inference="never-ready"))
    assert caught.value.hint == "Call start_perception first."
    assert time.monotonic() - started_s < 25.0
    assert supervisor.view("inference").phase == "stopped"


def test_what_is_being_started_is_waited_for(supervisor: Supervisor, make_config: MakeConfig) -> None:
    config = make_config(12.0, inference="never-ready", perception="slow-configure")
    starting = threading.Thread(target=lambda: supervisor.start("perception", config))
    starting.start()
    with pytest.raises(NotReadyError, match="was not ready within 12 s"):
        supervisor.start("inference", config)
    starting.join(30.0)
    assert supervisor.view("perception").phase == "running"
