"""No agent gets what only the simulator knows."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_eval.agents.cell import EpisodeFolder
from rn_eval.agents.task import AgentScene
from rn_simulation.ground_truth import SWITCH
from rn_simulation.scene_state import HANDED_OVER_TOPIC, TOPIC
from rn_standard.console import client
from roboneuron.direct_path import truth


def test_all_packages_mean_the_same_switch_and_topics(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SWITCH, raising=False)
    assert truth.SWITCH == client.TRUTH_SWITCH == SWITCH
    assert truth.is_withheld(TOPIC)
    assert truth.is_withheld(f"/fr3/{HANDED_OVER_TOPIC}")
    assert not truth.is_withheld("/fr3/joint_states")
    monkeypatch.setenv(SWITCH, "on")
    assert not truth.is_withheld(TOPIC)


def test_the_server_of_an_episode_does_not_tell_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SWITCH, "on")
    cell = EpisodeFolder(tmp_path, AgentScene(seed=1, instruction="Look."))
    assert cell.environment()[SWITCH] == "off"
