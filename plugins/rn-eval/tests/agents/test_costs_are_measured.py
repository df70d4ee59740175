"""Token counts of the traffic, and the time until a broken cell works again."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from rn_eval.agents import breakage as breakage_module
from rn_eval.agents import tokens
from rn_eval.agents.breakage import Breakage
from rn_eval.agents.task import InjectedFault
from rn_eval.agents.tokens import ReadTexts
from rn_eval.agents.truth import Truth


@pytest.fixture
def words(monkeypatch: pytest.MonkeyPatch):
    """An encoding with a token for each word."""
    module = ModuleType("tiktoken")
    module.get_encoding = lambda name: SimpleNamespace(encode_ordinary=str.split)
    monkeypatch.setitem(sys.modules, "tiktoken", module)
    tokens.encoding.cache_clear()
    yield
    tokens.encoding.cache_clear()


def passed() -> ReadTexts:
    texts = ReadTexts()
    texts.note(texts.lists, "three short words")
    texts.note(texts.requests, {"name": "move_ee"})
    picture = {"type": "image", "data": "a b c d"}
    texts.note_answer({"content": [{"type": "text", "text": "it moved"}, picture]})
    texts.note_answer({"structuredContent": {"text": "a b c"}})
    texts.note_answer(None)
    return texts


@pytest.mark.usefixtures("words")
def test_tokens_are_those_of_texts_and_not_of_pictures():
    assert passed().counted() == {"list_tokens": 3, "answer_tokens": 2, "request_tokens": 1}


@pytest.mark.usefixtures("words")
def test_more_than_can_be_kept_is_not_counted(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(tokens, "_MOST_CHARACTERS", 20)
    assert set(passed().counted().values()) == {None}


def test_without_tiktoken_or_its_table_nothing_is_counted(monkeypatch: pytest.MonkeyPatch, caplog):
    monkeypatch.setitem(sys.modules, "tiktoken", None)
    tokens.encoding.cache_clear()
    assert set(passed().counted().values()) == {None}
    module = ModuleType("tiktoken")

    def no_table(name: str) -> object:
        raise OSError("no network")

    module.get_encoding = no_table
    monkeypatch.setitem(sys.modules, "tiktoken", module)
    tokens.encoding.cache_clear()
    assert set(passed().counted().values()) == {None}
    assert "no network" in caplog.text
    tokens.encoding.cache_clear()


class Wire:
    """An episode as the fault injection sees it: run_task was called after 2 s."""

    pid = 1

    def __init__(self) -> None:
        self.time_s = 0.0

    def now_s(self) -> float:
        return self.time_s

    def first_call_s(self, tool: str) -> float | None:
        return 2.0 if self.time_s >= 2.0 and tool == "run_task" else None


def moving_from(begin_s: float) -> Truth:
    t_s = np.arange(0.0, 12.0, 0.02)
    joints = np.zeros((t_s.size, 7))
    joints[:, 0] = np.clip(t_s - begin_s, 0.0, None) * 0.5
    return Truth(
        t_s=t_s,
        joints_rad=joints,
        finger_m=np.zeros(t_s.size),
        tcp_m=np.zeros((t_s.size, 3)),
        names=(),
        cubes_m=np.zeros((t_s.size, 0, 3)),
        edges_m=np.zeros(0),
    )


def test_recovery_is_from_the_fault_to_motion_with_the_new_process(
    monkeypatch: pytest.MonkeyPatch,
):
    pids = {"control": 11}
    ended: list[tuple[int, str]] = []
    monkeypatch.setattr(breakage_module, "module_pid", lambda server, module: pids.get(module))
    monkeypatch.setattr(breakage_module, "end_module", lambda pid, kind: ended.append((pid, kind)))
    wire, made = Wire(), Breakage(InjectedFault(module="control", kind="kill", delay_s=1.0))
    for time_s, pid in ((1.0, 11), (2.5, 11), (3.0, 11), (4.0, None), (5.0, 12), (6.0, 13)):
        wire.time_s, pids["control"] = time_s, pid
        made.look(wire)
    assert ended == [(11, "kill")]
    assert (made.caused_s, made.restarted_s) == (3.0, 5.0)
    assert made.recovery_s(moving_from(8.0)) == pytest.approx(5.0, abs=0.1)
    assert made.recovery_s(moving_from(1.0)) == pytest.approx(2.0, abs=0.1)
    assert made.recovery_s(moving_from(20.0)) is None
    assert Breakage(None).recovery_s(moving_from(1.0)) is None
