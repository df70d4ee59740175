"""Robots and a policy server on another machine: answers, and compatible options."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from policy_servers import (
    SEEN,
    Robot,
    Serve,
    ahead_of,
    answers,
)

from rn_backend_openpi.case import Reflex, ReflexOptions
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError
from roboneuron.cli.main import main

pytestmark = pytest.mark.timeout(200)


@pytest.mark.parametrize("coding", ["raw", "png"])
@pytest.mark.sampled(every=2)
def test_answers_over_tls_equal_those_of_the_same_backend_here_bit_for_bit(
    serve: Serve, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, coding: str
) -> None:
    # the model shrinks images, so the robot does it before sending
    own = {"rows": 6, "shrinks_to": [64, 48]}
    server = serve({"only": {"options": own}})
    far = robot(server.address, coding=coding)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    alone = Reflex(ReflexOptions(**own))
    alone.load()
    drawn = np.random.default_rng(0)
    assert SEEN.ee_pose is not None
    for index in range(20):
        image = drawn.integers(0, 256, (224, 224, 3), dtype=np.uint8)
        observation = replace(
            SEEN,
            frames={"primary": replace(SEEN.frames["primary"], image=image)},
            ee_pose=replace(SEEN.ee_pose, position_m=drawn.normal(size=3)),
        )
        there = far.predict(observation)
        assert alone.predict(observation).actions.tobytes() == there.actions.tobytes(), index
    metrics = there.metrics
    assert metrics["shared.image_kb"] < 3 * 64 * 48 / 1e3 + 1.0
    parts = [metrics[f"shared.{part}_ms"] for part in ("link", "queue", "model")]
    assert sum(parts) == pytest.approx(metrics["shared.round_trip_ms"])
    told = far.predict(replace(observation, ahead=ahead_of(there)))
    np.testing.assert_array_equal(told.actions[:3], there.actions[1:4])
    assert told.metrics["continues"] > 0.0, "rows go on over the network"


def test_no_more_robots_than_allowed_are_taken(serve: Serve, robot: Robot, tmp_path: Path) -> None:
    server = serve(keys="token", robots=1)
    token = str(tmp_path / "token")
    one = robot(server.address, token_file=token)
    with pytest.raises(NotReadyError, match="no more are taken"):
        robot(server.address, token_file=token, start_timeout_s=0.5)
    assert answers(one)
    one.close()
    wait_until(lambda: server.status()["robots"] == 0, 20.0)
    assert answers(robot(server.address, token_file=token))


def test_a_wrong_file_is_one_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policies.toml"
    for text, expected in (
        ("", "models"),
        ("[models.a]\n", "backend"),
        ("[models.a]\nbackend = 'oft'\nmodle = 1", "modle"),
        ("[listen]\nkeys = 'token'\n[models.a]\nbackend = 'oft'", "token_file"),
        ("[[[", "cannot be read"),
    ):
        path.write_text(text)
        assert main(["policy", "serve", "--config", str(path)]) != 0
        assert expected in capsys.readouterr().err
