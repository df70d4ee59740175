"""The cell of an episode: its configuration can be read, a stop can be latched, processes end."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rn_eval.agents.cell import EpisodeFolder, end_process
from rn_eval.agents.task import AgentScene, Companion
from rn_eval.agents.tasks.refuse import PERSON_M
from roboneuron.command import load_config
from roboneuron.feature import estop


def cell_of(tmp_path: Path, **scene: object) -> EpisodeFolder:
    values = {"seed": 3, "instruction": "Pick.", "colours": ("red", "blue"), **scene}
    made = EpisodeFolder(tmp_path, AgentScene(**values))
    made.prepare()
    return made


def test_the_configuration_is_that_of_the_scene(tmp_path: Path):
    cell = cell_of(tmp_path, zones_m=(PERSON_M,))
    config = load_config(cell.configuration)
    assert config.plugins["fr3"] == {"seed": 3, "colours": ["red", "blue"]}
    assert tuple(map(tuple, (config.limits.zones[0].lower_m, config.limits.zones[0].upper_m))) == (
        PERSON_M
    )
    assert config.supervisor.state_directory == str(cell.state)
    assert not cell.is_latched()
    assert cell.environment()["ROBONEURON_RECORDER"] == "off"
    assert cell_of(tmp_path, records=True).environment()["ROBONEURON_RECORDER"] == "on"


def test_several_robots_have_a_table_each(tmp_path: Path):
    others = (
        Companion(name="right", seed=9, colours=("green",)),
        Companion(name="base", robot="diffdrive"),
    )
    cell = cell_of(tmp_path, robot="left", companions=others, slip_after_s=2.5)
    robots = load_config(cell.configuration).robots
    assert set(robots) == {"left", "right", "base"}
    assert robots["left"].plugins["fr3"] == {"seed": 3, "colours": ["red", "blue"]}
    assert robots["right"].plugins["fr3"] == {"seed": 9, "colours": ["green"]}
    assert robots["base"].control is None
    assert cell.environment()["ROBONEURON_SIMULATOR_SLIP"] == "2.5"
    assert cell_of(tmp_path).environment()["ROBONEURON_SIMULATOR_SLIP"] == ""
    own = estop.EmergencyStopLatch.in_directory(cell.state / "robots" / "left")
    own.latch(who="agent", reason="")
    assert [cell.is_latched(robot) for robot in ("left", "right", "")] == [True, False, False]


def test_a_scene_with_several_robots_has_nothing_that_belongs_to_one():
    with pytest.raises(ValueError, match="several robots"):
        AgentScene(
            seed=0, instruction="", companions=(Companion(name="b"),), recorded_note="morning"
        )


def test_a_stop_is_latched_and_released_by_a_person(tmp_path: Path):
    cell = cell_of(tmp_path, latched="smoke")
    assert cell.is_latched()
    cell.release_as_person()
    assert not cell.is_latched()


def test_recordings_are_files_with_something_in_them(tmp_path: Path):
    cell = cell_of(tmp_path)
    folder = cell.state / "runs" / "morning"
    folder.mkdir(parents=True)
    (folder / "empty.mcap").touch()
    (folder / "part-0001.mcap").write_bytes(b"x")
    assert cell.recordings() == ("runs/morning/part-0001.mcap",)


def test_a_process_ends_with_what_it_has_started():
    code = (
        "import signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True
    ) as process:
        child = int(process.stdout.readline())
        end_process(process, 0.3)
        assert process.returncode == -9
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s and is_alive(child):
        time.sleep(0.02)
    assert not is_alive(child)


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return state != "Z"


@pytest.mark.parametrize("question", ["", "<colour>"])
def test_an_agent_is_told_the_form_of_its_last_words(question):
    told = AgentScene(seed=0, instruction="Look.", answer_form=question).briefing
    assert told.startswith("Look.\n\n")
    assert "CLAIM: refused: <why>" in told
    assert ("ANSWER: <colour>" in told) == bool(question)
