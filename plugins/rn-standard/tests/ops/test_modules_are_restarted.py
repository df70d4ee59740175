"""Restarts of real module processes that are killed and frozen."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rn_standard.ops.options import OpsOptions
from rn_standard.ops.restarts import Restarts
from rn_testing.fakes import fake_plan
from rn_testing.waiting import wait_until
from roboneuron.config import Config
from roboneuron.modules.settings import ModuleKind
from roboneuron.plugins.discovery import discover
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.health import Watch
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
Make = Callable[..., tuple[Restarts, list[str]]]


@pytest.fixture
def make_restarts(supervisor: Supervisor, config: Config) -> Iterator[Make]:
    """Return a function: options to the restarts, and what they tell."""
    ended: list[Callable[[], None]] = []

    def make(**options: Any) -> tuple[Restarts, list[str]]:
        told: list[str] = []
        rules = OpsOptions.model_validate(
            {"restart_backoff_s": 0.1, "unresponsive_s": 0.6} | options
        )
        loop = ClosedLoop(config, discover, supervisor)
        made = Restarts(
            loop, rules, lambda kind, what: told.append(f"{kind}: {what}"), load=lambda: 0.0
        )
        watch = Watch(supervisor.views, made.on_health)
        watch.start()
        ended.extend((made.close, watch.close))
        return made, told

    yield make
    for end in ended:
        end()


def pid_of(supervisor: Supervisor, kind: ModuleKind) -> int:
    """Process id of a running module; 0 when there is none."""
    view = supervisor.view(kind)
    return view.process.pid if view.phase == "running" and view.process is not None else 0


def test_perception_is_restarted_a_few_times_and_the_robot_is_not(
    supervisor: Supervisor, config: Config, make_restarts: Make
) -> None:
    _, told = make_restarts(restart_limit=2)
    supervisor.start(fake_plan("robot", config))
    supervisor.start(fake_plan("perception", config))
    first = pid_of(supervisor, "perception")
    os.kill(first, signal.SIGKILL)
    wait_until(
        lambda: pid_of(supervisor, "perception") not in (0, first), 40.0, "perception is restarted"
    )
    second = pid_of(supervisor, "perception")
    os.kill(second, signal.SIGSTOP)
    wait_until(
        lambda: pid_of(supervisor, "perception") not in (0, second),
        40.0,
        "a frozen one is replaced",
    )
    for kind in ("perception", "robot"):
        os.kill(pid_of(supervisor, kind), signal.SIGKILL)  # type: ignore[arg-type]
    wait_until(
        lambda: any("not restarted: 2 restarts" in text for text in told), 20.0, "the limit is told"
    )
    assert supervisor.view("robot").phase == "exited"
    assert not any(text.startswith("robot") for text in told)


@pytest.mark.exhaustive
def test_a_module_is_restarted_only_when_the_configuration_says_so(
    supervisor: Supervisor, config: Config, make_restarts: Make
) -> None:
    _, told = make_restarts(restart={"perception": "never", "robot": "on_failure"})
    supervisor.start(fake_plan("robot", config))
    supervisor.start(fake_plan("perception", config))
    before = pid_of(supervisor, "robot")
    os.kill(pid_of(supervisor, "perception"), signal.SIGKILL)
    os.kill(before, signal.SIGKILL)
    wait_until(
        lambda: pid_of(supervisor, "robot") not in (0, before),
        40.0,
        "the robot module is restarted",
    )
    assert supervisor.view("perception").phase == "exited"
    assert not any(text.startswith("perception") for text in told)


def test_a_stop_ends_a_pending_restart(
    supervisor: Supervisor, config: Config, make_restarts: Make
) -> None:
    made, told = make_restarts(restart_backoff_s=2.0)
    process = supervisor.start(fake_plan("perception", config)).process
    assert process is not None
    process.kill()
    wait_until(lambda: made.cancel("perception"), 5.0, "a restart is pending")
    wait_until(lambda: not made.cancel("perception"), 5.0, "it is given up")
    assert supervisor.view("perception").phase == "exited"
    assert told == []
