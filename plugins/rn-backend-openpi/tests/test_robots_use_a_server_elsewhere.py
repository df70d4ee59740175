"""Robots and a policy server on another machine: answers, and compatible options."""

from __future__ import annotations

import socket
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from policy_servers import (
    SEEN,
    Robot,
    Serve,
    answers,
)

from rn_backend_openpi.case import Reflex, ReflexOptions
from rn_testing.waiting import wait_until
from roboneuron import (
    Ahead,
    ConfigurationError,
    NotReadyError,
    RoboNeuronError,
)
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


@pytest.mark.exhaustive
def test_jpeg_is_used_as_far_as_it_moves_actions_no_further_than_allowed(
    serve: Serve, robot: Robot
) -> None:
    server = serve()
    metrics = robot(server.address, coding="jpeg", quality=80).predict(SEEN).metrics
    assert 0.0 < metrics["shared.parity_m"] < 0.002
    assert metrics["shared.coding"] == 2.0
    strict = robot(server.address, coding="jpeg", quality=80, parity_m=0.0)
    with pytest.raises(ConfigurationError, match="parity_m = 0 are allowed"):
        strict.predict(SEEN)


def test_real_time_chunking_goes_on_over_the_network(serve: Serve, robot: Robot) -> None:
    far = robot(serve({"only": {"options": {"rows": 6}}}).address, coding="raw")
    first = far.predict(SEEN)
    ahead = Ahead(
        rows=first.actions[1:],
        committed_rows=3,
        step_s=0.1,
        context=first.context,
        context_row=1,
    )
    told = far.predict(replace(SEEN, instruction="x", ahead=ahead))
    assert told.conditioned_rows == 3
    np.testing.assert_array_equal(told.actions[:3], first.actions[1:4])
    assert told.metrics["continues"] == 101.0


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
        assert main(["serve-policy", "--config", str(path)]) != 0
        assert expected in capsys.readouterr().err


def test_a_server_that_is_not_there_is_an_error_after_a_while(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = tmp_path / "token"
    token.write_text("x" * 32)
    token.chmod(0o600)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(RoboNeuronError, match="cannot be reached"):
        robot(f"127.0.0.1:{port}", token_file=str(token), start_timeout_s=0.5)
