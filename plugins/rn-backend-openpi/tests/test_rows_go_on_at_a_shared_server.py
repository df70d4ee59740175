"""Rows executed during inference are continued by the next answer of a shared server."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import (
    SEEN,
    Robot,
    seen,
)

from rn_backend_openpi.case import install, options_in
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    ActionChunk,
    Ahead,
    Observation,
)

pytestmark = pytest.mark.timeout(200)


def test_rows_that_are_played_meanwhile_are_continued_with_the_context_that_the_server_holds(
    served: Robot,
) -> None:
    one, other = (served(options={"rows": 6}) for _ in range(2))
    first = one.predict(SEEN)
    ahead = Ahead(
        rows=first.actions[1:],
        committed_rows=2,
        step_s=first.step_s,
        context=first.context,
        context_row=1,
    )
    told = one.predict(replace(seen(3), ahead=ahead))
    assert told.conditioned_rows == 2
    np.testing.assert_array_equal(told.actions[:2], ahead.rows[:2])
    assert told.metrics["continues"] == 101.0, "the model has got its own context back"
    # a context of another connection is ignored, even if this one has a context of that number
    other.predict(SEEN)
    assert other.predict(replace(seen(3), ahead=ahead)).metrics["continues"] == -1.0
    # likewise one that is no longer held
    for _ in range(8):
        one.predict(SEEN)
    assert one.predict(replace(seen(3), ahead=ahead)).metrics["continues"] == -1.0


def test_robots_whose_rows_go_on_are_answered_one_by_one(served: Robot) -> None:
    robots = [served(options={"rows": 6, "took_s": 0.02}, linger_s=0.1) for _ in range(3)]
    rows = np.tile([0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5], (4, 1))

    def ask(index: int) -> int:
        ahead = Ahead(rows=rows * [index, 1, 1, 1, 1, 1, 1], committed_rows=3, step_s=0.1)
        told = robots[index].predict(replace(SEEN, ahead=ahead))
        np.testing.assert_array_equal(told.actions[:3], ahead.rows[:3])
        return told.conditioned_rows

    with ThreadPoolExecutor(3) as pool:
        for _ in range(5):
            assert list(pool.map(ask, range(3))) == [3, 3, 3]


def test_a_batch_holds_those_whose_rows_do_not_go_on(tmp_path: Path) -> None:
    install(tmp_path)
    sys.path.insert(0, str(tmp_path / "site"))
    try:
        for continues in (True, False):
            options = options_in(tmp_path, options={"rows": 6, "continues": continues})
            model = SharedModel(PolicyOptions.model_validate(options))
            model.load()
            asked: list[int] = []
            many = model._many
            assert many is not None

            def counted(
                observations: Sequence[Observation], many: Any = many, asked: list[int] = asked
            ) -> Any:
                asked.append(len(observations))
                return many(observations)

            model._many = counted
            ahead = Ahead(rows=np.zeros((4, 7)), committed_rows=3, step_s=0.1)
            given = [seen(0), replace(seen(1), ahead=ahead), seen(2)]
            told = [chunk for chunk in model.answer(given) if isinstance(chunk, ActionChunk)]
            assert [chunk.conditioned_rows for chunk in told] == [0, 3 if continues else 0, 0]
            assert asked == [2 if continues else 3]
            alone = [model.answer([one])[0] for one in given]
            for chunk, single in zip(told, alone, strict=True):
                assert isinstance(single, ActionChunk)
                if chunk.conditioned_rows == single.conditioned_rows:
                    np.testing.assert_allclose(chunk.actions, single.actions, rtol=0, atol=1e-5)
    finally:
        sys.path.remove(str(tmp_path / "site"))
