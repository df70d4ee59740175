"""list_tasks: what was tried before, kept over restarts, bounded."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.ops.plugin import CLIENTS
from rn_standard.tasks import history as history_module
from rn_standard.tasks.history import TASKS_URI, TaskHistory
from rn_standard.tasks.plugin import FEATURE
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application


def history(folder: Path) -> TaskHistory:
    return TaskHistory(folder, lambda: datetime(2026, 11, 26, 9, 0, tzinfo=UTC))


def test_what_was_noted_is_there_after_a_restart_newest_first(tmp_path: Path) -> None:
    first = history(tmp_path)
    first.note("pick up the red cube", "failed", "It slipped.", attempts=3, took_s=41.23)
    first.note("Wave", "succeeded", "", robot="simulated fr3", model={"backend": "servo"})
    newest, older = history(tmp_path).newest()
    assert (newest.instruction, newest.model) == ("Wave", {"backend": "servo"})
    assert (older.outcome, older.reason, older.attempts) == ("failed", "It slipped.", 3)
    assert (older.took_s, older.at) == (41.2, "2026-11-26T09:00:00+00:00")
    assert (tmp_path / "tasks.jsonl").stat().st_mode & 0o077 == 0


def test_only_instructions_with_all_words_are_found(tmp_path: Path) -> None:
    kept = history(tmp_path)
    for words in ("Pick up the red cube", "pick up the blue cube", "wave"):
        kept.note(words, "succeeded", "")
    assert [t.instruction for t in kept.newest("CUBE red")] == ["Pick up the red cube"]
    assert len(kept.newest("pick")) == 2
    assert kept.newest("cup") == []


def test_the_file_stays_bounded_and_a_cut_line_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(history_module, "KEPT", 5)
    kept = history(tmp_path)
    for number in range(23):
        kept.note(f"task {number} " + "x" * 2000, "succeeded", "y" * 2000)
    path = tmp_path / "tasks.jsonl"
    assert len(path.read_text().splitlines()) <= 10
    assert [task.instruction.split()[1] for task in kept.newest()] == ["22", "21", "20", "19", "18"]
    assert max(len(task.reason) for task in kept.newest()) == 500
    with path.open("a") as file:
        file.write('{"instruction": "cut')
    assert len(kept.newest()) == 4


def test_a_file_that_cannot_be_written_fails_no_task(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "tasks.jsonl").mkdir()
    history(tmp_path).note("pick up the red cube", "succeeded", "")
    assert "cannot be written" in caplog.text


def test_agents_read_it_as_a_tool_and_as_a_resource(tmp_path: Path) -> None:
    state = tmp_path / "state"
    kept = history(state)
    for number in range(12):
        kept.note(f"task {number}", "succeeded", "")
    registry = fake_registry(SELECTION, FEATURE, CLIENTS, DIRECT_PATH)
    application = Application(
        parse_config('[robot]\nname = "gantry"\n', registry=registry),
        plugins=lambda: registry,
        directory=state,
    )

    async def ask() -> tuple[dict[str, Any], list[dict[str, Any]]]:
        async with Client(application.server) as client:
            answer = await client.call_tool("list_tasks", {"entries": 3})
            resource = await client.read_resource(TASKS_URI)
            return dict(answer.structured_content or {}), json.loads(resource.contents[0].text)  # type: ignore[union-attr]

    try:
        listed, read = anyio.run(ask)
    finally:
        application.close()
    assert [task["instruction"] for task in listed["tasks"]] == ["task 11", "task 10", "task 9"]
    assert listed["more"] == 9
    assert "reason" not in listed["tasks"][0]
    assert len(read) == 12
    assert os.path.getsize(state / "tasks.jsonl") < 5000
