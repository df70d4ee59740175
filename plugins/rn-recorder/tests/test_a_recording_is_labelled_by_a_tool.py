"""The tool label_recording stores what a person says as the command `runs label` does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_recorder.tools import LabelRecording, RecordingEnds, recording_tools
from rn_recorder_runs.files import write_json
from rn_recorder_runs.store import LABELS, RUN_FILE, WHOLE_RUN, RunStore
from roboneuron import InvalidInputError

Do = Callable[..., Any]


class Context:
    """Runs work at once."""

    simulated = False

    who, role = "ann", "operator"

    async def run(self, work: Callable[[Callable[[str], None]], Any]) -> Any:
        return work(lambda _: None)


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    """With one recording that was stopped as a failure."""
    made = RunStore(tmp_path)
    made.make()
    folder = made.recordings / "20260101-run"
    folder.mkdir()
    (folder / "part-0001.mcap").write_bytes(b"")
    write_json(folder / RUN_FILE, {"state": "finished", "outcome": "failure", "note": "first"})
    return made


@pytest.fixture
def label(store: RunStore) -> Do:
    tools = {
        tool.name: tool for tool in recording_tools(store, lambda: None, False, RecordingEnds())
    }

    def do(**arguments: Any) -> Any:
        handler = tools["label_recording"].handler
        return anyio.run(handler, LabelRecording(**arguments), Context())

    return do


def test_what_is_said_is_stored_as_by_the_command(store: RunStore, label: Do) -> None:
    said = label(run="20260101-run", outcome="success", comment="turned")
    assert (said.outcome, said.comment) == ("success", "turned")
    by_tool = store.get("20260101-run").facts
    store.label(store.get("20260101-run"), outcome="success", comment="turned")
    assert store.get("20260101-run").facts == by_tool
    assert by_tool[LABELS] == {WHOLE_RUN: {"outcome": "success", "comment": "turned"}}


def test_what_is_not_said_stays(store: RunStore, label: Do) -> None:
    said = label(run="latest", comment="too fast")
    assert (said.outcome, said.comment) == ("failure", "too fast")
    with pytest.raises(InvalidInputError, match="nothing to say"):
        label(run="latest")
    with pytest.raises(InvalidInputError, match="No run begins"):
        label(run="other", outcome="success")
    assert store.get("latest").told == {"outcome": "failure", "comment": "too fast"}
