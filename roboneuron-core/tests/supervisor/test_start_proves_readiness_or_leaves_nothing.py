"""Starting module processes, and the remains of a failed start: none."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from rn_testing.fakes import fake_plan
from roboneuron.config import Config
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    NotReadyError,
    StateError,
    UngroundedError,
)
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
MakeConfig = Callable[..., Config]


def is_gone(pid: int) -> bool:
    """True if the process is no longer in the process table, not even as a zombie."""
    return not os.path.exists(f"/proc/{pid}")


def children() -> set[int]:
    """Pids of all children of this process."""
    tasks = f"/proc/{os.getpid()}/task"
    found = set()
    for task in os.listdir(tasks):
        # it has ended
        with (
            suppress(FileNotFoundError, ProcessLookupError),
            open(f"{tasks}/{task}/children") as file,
        ):
            found |= {int(word) for word in file.read().split()}
    return found


def test_a_started_module_is_active_ready_and_reported(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    stages: list[str] = []
    view = supervisor.start(
        fake_plan("robot", make_config(), names={"robot": "fake"}), on_stage=stages.append
    )
    assert view.phase == "running"
    assert view.report is not None
    assert view.report.state == "active"
    assert view.report.ready
    assert view.report.detail == {"cube_z_m": "0.025"}
    assert view.report.emergency_stop is False
    assert [stage for stage in stages if " of at most " not in stage] == [
        "robot: starting",
        "robot: configuring",
        "robot: activating",
        "robot: waiting for the first output",
    ]


def test_answers_that_are_lost_hinder_neither_start_nor_stop(
    supervisor: Supervisor, make_config: MakeConfig, caplog: pytest.LogCaptureFixture
) -> None:
    view = supervisor.start(
        fake_plan("robot", make_config(start_timeout_s=15.0, robot="loses-answers"))
    )
    assert view.report is not None
    assert view.report.state == "active"
    stopped = supervisor.stop("robot")
    assert (stopped.exit_code, stopped.killed) == (0, False)
    assert "did not answer" not in caplog.text


def test_a_refused_configure_raises_the_modules_own_error(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    before = children()
    with pytest.raises(CheckpointError, match="truncated: 3 of 7 shards") as caught:
        supervisor.start(fake_plan("robot", make_config(robot="refuses-configure")))
    assert caught.value.hint == "Download them again."
    assert supervisor.view("robot").phase == "stopped"
    assert children() == before


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("dies-at-once", ["exit code 7", "cannot open the thing"]),
        (
            "dies-in-configure",
            ["exit code 11", "while configuring", "segmentation fault, not really"],
        ),
    ],
)
def test_a_death_during_the_start_is_told_with_the_last_lines(
    supervisor: Supervisor, make_config: MakeConfig, fault: str, words: list[str]
) -> None:
    before = children()
    with pytest.raises(NotReadyError) as caught:
        supervisor.start(fake_plan("robot", make_config(robot=fault)))
    for word in words:
        assert word in str(caught.value)
    assert children() == before


def test_what_is_missing_is_named_when_the_time_is_over(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    before = children()
    with pytest.raises(
        NotReadyError, match=r"not ready within 10 s; missing: images on camera/front/image"
    ):
        supervisor.start(
            fake_plan("perception", make_config(start_timeout_s=10.0, perception="never-ready"))
        )
    assert children() == before
    assert supervisor.view("perception").phase == "stopped"


def test_a_hang_in_configure_ends_at_the_timeout_of_that_module(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    before = children()
    config = make_config(start_timeout_s=600.0, stop_timeout_s=0.5, robot="hangs-in-configure")
    config = config.model_copy(
        update={"robot": config.robot.model_copy(update={"start_timeout_s": 10.0})}
    )
    stages: list[str] = []
    with pytest.raises(NotReadyError, match="missing: the answer to 'configure'") as caught:
        supervisor.start(fake_plan("robot", config), on_stage=stages.append)
    assert "raise start_timeout_s in [robot]" in caught.value.hint
    assert any(
        re.fullmatch(r"robot: configuring, \d+ of at most 10 s, \d+\.\d GB in memory", s)
        for s in stages
    )
    assert children() == before


def test_an_error_that_stays_ends_the_start_with_that_error(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    with pytest.raises(UngroundedError, match="Nothing here is a 'red cube'"):
        supervisor.start(fake_plan("inference", make_config(inference="fails-when-active")))


def test_a_second_start_says_what_is_running_and_harms_nothing(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    view = supervisor.start(fake_plan("inference", make_config(), names={"backend": "fake"}))
    assert view.process is not None
    with pytest.raises(
        StateError, match=rf"already running \(pid {view.process.pid}, backend 'fake', since \d\d:"
    ):
        supervisor.start(fake_plan("inference", make_config()))
    assert supervisor.require_running("inference").process is view.process


def test_a_start_during_a_start_is_refused_and_the_first_succeeds(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    configuring = threading.Event()
    config = make_config(robot="slow-configure")

    def on_stage(stage: str) -> None:
        if stage == "robot: configuring":
            configuring.set()

    first = threading.Thread(target=supervisor.start, args=(fake_plan("robot", config), on_stage))
    first.start()
    assert configuring.wait(20)
    with pytest.raises(StateError, match="already starting"):
        supervisor.start(fake_plan("robot", config))
    first.join(20)
    assert supervisor.view("robot").phase == "running"


def test_a_stop_during_a_start_cancels_it(supervisor: Supervisor, make_config: MakeConfig) -> None:
    configuring = threading.Event()
    errors: list[BaseException] = []

    def start() -> None:
        try:
            supervisor.start(
                fake_plan("robot", make_config(stop_timeout_s=0.5, robot="hangs-in-configure")),
                on_stage=lambda stage: configuring.set() if stage == "robot: configuring" else None,
            )
        except StateError as error:
            errors.append(error)

    before = children()
    first = threading.Thread(target=start)
    first.start()
    assert configuring.wait(20)
    assert supervisor.stop("robot").cancelled_start
    first.join(5)
    assert not first.is_alive()
    assert "stop_robot was called" in str(errors[0])
    assert children() == before


def test_a_module_of_another_server_is_neither_driven_nor_disturbed(
    supervisor: Supervisor,
    make_config: MakeConfig,
    tmp_path: Path,
    fake_command: Callable[[str | None], list[str]],
) -> None:
    first = supervisor.start(fake_plan("robot", make_config()))
    assert first.process is not None
    other = Supervisor(tmp_path / "other", command=fake_command)
    try:
        with pytest.raises(StateError, match=rf"as process {first.process.pid} of another server"):
            other.start(fake_plan("robot", make_config()))
    finally:
        other.close()
    view = supervisor.require_running("robot")
    assert view.report is not None
    assert view.report.state == "active"


def test_a_state_directory_that_cannot_be_written_is_named(
    tmp_path: Path, make_config: MakeConfig, fake_command: Callable[[str | None], list[str]]
) -> None:
    (tmp_path / "file").touch()
    other = Supervisor(tmp_path / "file" / "state", command=fake_command)
    try:
        for attempt in (other.open, lambda: other.start(fake_plan("robot", make_config()))):
            with pytest.raises(
                ConfigurationError, match=r"The state directory .*/file/state.* cannot be written"
            ) as caught:
                attempt()
            assert "XDG_STATE_HOME" in caught.value.hint
    finally:
        other.close()
