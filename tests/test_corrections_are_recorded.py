"""benchmarks/record_corrections.py notices why a policy fails, and continues its ledger."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import record_corrections
from record_corrections import BROKEN, CORRECTED, FAILED, Ledger, why_it_fails

from rn_policy_cubes.demonstrations import COLOURS, ROW


class Scene:
    """A scene that stays as it is, but for the TCP, which moves with each look."""

    def __init__(self, opening: float, lifted: str = "", *, moves: bool = True) -> None:
        self.row_now = np.zeros((), dtype=ROW)
        self.row_now["opening"], self.row_now["edge_m"] = opening, 0.04
        self.row_now["cube_m"][:, 2] = 0.02
        if lifted:
            self.row_now["cube_m"][COLOURS.index(lifted), 2] = 0.2
        self._moves = moves

    def row(self, colour: str) -> np.ndarray:
        if self._moves:
            self.row_now["tcp_m"][0] += 0.1
        return self.row_now.copy()

    def lifted_m(self) -> dict[str, float]:
        row = self.row_now
        heights = row["cube_m"][:, 2] - row["edge_m"] / 2
        return dict(zip(COLOURS, heights.tolist(), strict=True))


@pytest.mark.parametrize(
    ("scene", "why"),
    [
        (Scene(0.5, "red"), ""),
        (Scene(0.5, "green"), "it lifts the green cube"),
        (Scene(0.1), "it closes on nothing"),
        (Scene(1.0, moves=False), "it stands still"),
        (Scene(1.0), "not lifted within 0.5 s"),
    ],
)
def test_the_person_sees_why_the_policy_fails(
    monkeypatch: pytest.MonkeyPatch, scene: Scene, why: str
) -> None:
    for name in ("HELD_S", "NOTHING_S", "STILL_S"):
        monkeypatch.setattr(record_corrections, name, 0.1)
    monkeypatch.setattr(record_corrections, "PATIENCE_S", 0.5)
    assert why_it_fails(scene, "red") == why  # type: ignore[arg-type]


def test_an_episode_that_was_played_is_not_played_again(tmp_path: Path) -> None:
    path = tmp_path / "ledger.jsonl"
    ledger = Ledger(path)
    ledger.add({"seed": 1, "colour": "red", "outcome": CORRECTED})
    ledger.add({"seed": 1, "colour": "green", "outcome": FAILED})
    ledger.add({"seed": 1, "colour": "blue", "outcome": BROKEN})
    with path.open("a") as file:
        file.write(json.dumps({"seed": 1, "colour": "yellow"})[:10])
    again = Ledger(path)
    assert [again.has(1, colour) for colour in ("red", "green", "blue", "yellow")] == [
        True,
        True,
        False,
        False,
    ]
    assert again.count == 1
    for _ in range(2):
        again.add({"seed": 1, "colour": "blue", "outcome": BROKEN})
    assert Ledger(path).has(1, "blue")
