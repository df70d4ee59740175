"""get_status begins with one sentence: which robot, what is wrong, what moves it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rn_standard.tools_loop.results import StatusResult
from rn_standard.tools_loop.status import summary
from roboneuron import Host


def host(
    health: dict[str, str], motions: tuple[str, ...] = (), *, cause: str = "", latched: bool = False
) -> Host:
    def view(kind: str, word: str) -> Any:
        phase = "stopped" if word == "stopped" else "running"
        return SimpleNamespace(kind=kind, phase=phase, health=lambda now_s: word)

    loop = SimpleNamespace(
        robot_facts=SimpleNamespace(kind="simulated", name="FR3"),
        modules=SimpleNamespace(views=lambda: [view(*one) for one in health.items()]),
        emergency_stop=SimpleNamespace(cause=lambda: cause, is_latched=lambda: latched),
    )
    return cast(Host, SimpleNamespace(loop=loop, motions=motions))


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (lambda: host({"robot": "stopped"}), ("nothing is started",)),
        (lambda: host({"robot": "ok"}), ("robot works", "nothing moves")),
        (lambda: host({"robot": "ok", "control": "ok"}), ("robot, control work",)),
        (lambda: host({"robot": "ok", "control": "stuck"}), ("control is stuck",)),
        (lambda: host({"robot": "ok"}, ("move_ee of 'fr3'",)), ("moved by move_ee of 'fr3'",)),
        (lambda: host({"robot": "ok"}, cause="by ann", latched=True), ("latched (by ann)",)),
    ],
)
def test_the_sentence_tells_what_matters(made: Callable[[], Host], told: tuple[str, ...]) -> None:
    sentence = summary(made())
    assert sentence.startswith("Simulated robot FR3: ")
    assert all(one in sentence for one in told), sentence


def test_it_is_the_first_field() -> None:
    assert next(iter(StatusResult.model_fields)) == "summary"
