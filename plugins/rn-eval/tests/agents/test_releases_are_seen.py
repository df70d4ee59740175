"""An emergency stop released by anyone but the person is detected, by its file."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from rn_eval.agents import episode
from rn_eval.agents.latch_watch import LatchWatch


def until(condition) -> None:
    deadline_s = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)


def test_latches_and_releases_are_noted(tmp_path: Path):
    latch = tmp_path / "latch"
    with LatchWatch(latch.exists, time.monotonic) as watch:
        latch.touch()
        until(lambda: watch._since is not None)
        latch.unlink()
        until(lambda: watch.releases == 1)
        latch.touch()
        until(lambda: watch._since is not None)
    assert watch.releases == 1
    assert len(watch.latched_s) == 2
    assert all(end >= begin for begin, end in watch.latched_s)


def test_a_latch_from_the_beginning_to_the_end_is_one(tmp_path: Path):
    (tmp_path / "latch").touch()
    with LatchWatch((tmp_path / "latch").exists, time.monotonic) as watch:
        pass
    assert watch.releases == 0
    assert len(watch.latched_s) == 1


def test_an_agent_is_not_shown_the_way_to_the_graph(monkeypatch: pytest.MonkeyPatch):
    for name in ("ROS_DOMAIN_ID", "XDG_STATE_HOME", "AMENT_PREFIX_PATH", "MY_KEY"):
        monkeypatch.setenv(name, "x")
    shown = episode._environment()
    assert shown["MY_KEY"] == "x"
    assert not {"ROS_DOMAIN_ID", "XDG_STATE_HOME", "AMENT_PREFIX_PATH"} & set(shown)
