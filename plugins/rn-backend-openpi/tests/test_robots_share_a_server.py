"""Several robots share one server process: each gets its own answer, in batches that are exact."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import (
    SEEN,
    Robot,
    answers,
    seen,
    servers_in,
)

from rn_backend_openpi.case import Reflex, ReflexOptions, options_in
from rn_backend_openpi.client import PolicyClient
from rn_backend_openpi.links import directory_of
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.options import PolicyOptions
from rn_testing.waiting import wait_until
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    RoboNeuronError,
)

pytestmark = pytest.mark.timeout(200)


def test_robots_that_ask_at_once_share_one_batch_and_get_their_own_answer(
    served: Robot,
) -> None:
    robots = [served(options={"took_s": 0.05}, linger_s=0.1) for _ in range(6)]
    alone = [robots[0].predict(seen(index)).actions for index in range(6)]
    with ThreadPoolExecutor(6) as pool:
        for _ in range(20):
            together = list(pool.map(lambda index: robots[index].predict(seen(index)), range(6)))
            for chunk, expected in zip(together, alone, strict=True):
                # the bound
                np.testing.assert_allclose(chunk.actions, expected, rtol=0, atol=1e-5)
            if max(chunk.metrics["shared.batch"] for chunk in together) > 1:
                return
    pytest.fail("no two robots were ever answered in one batch")


def test_what_one_robot_sends_wrong_is_an_error_of_that_robot_only(served: Robot) -> None:
    robots = [served(linger_s=0.1) for _ in range(3)]
    asked = [SEEN, replace(SEEN, instruction="crash"), SEEN]

    def ask(index: int) -> RoboNeuronError | None:
        try:
            robots[index].predict(asked[index])
        except RoboNeuronError as error:
            return error
        return None

    with ThreadPoolExecutor(3) as pool:
        for _ in range(5):
            errors = list(pool.map(ask, range(3)))
            assert [type(error) for error in errors] == [type(None), InvalidInputError, type(None)]


def test_what_may_remember_robots_is_not_shared_unless_a_person_says_that_it_does_not(
    served: Robot,
) -> None:
    with pytest.raises(ConfigurationError, match="stateless = true"):
        served(backend="rememberer")
    assert served(backend="rememberer", stateless=True).predict(SEEN).metrics["shared.batch"] == 1.0


def test_raw_answers_equal_those_of_the_same_backend_here_bit_for_bit(
    served: Robot, tmp_path: Path
) -> None:
    robot = served(options={"rows": 6})
    alone = Reflex(ReflexOptions(rows=6))
    alone.load()
    drawn = np.random.default_rng(0)
    assert SEEN.joints is not None
    assert SEEN.ee_pose is not None
    for index in range(20):
        image = drawn.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        observation = replace(
            SEEN,
            frames={"primary": replace(SEEN.frames["primary"], image=image)},
            joints=replace(SEEN.joints, position=drawn.normal(size=len(SEEN.joints.names))),
            ee_pose=replace(SEEN.ee_pose, position_m=drawn.normal(size=3)),
            gripper_open=float(drawn.random()),
        )
        here, there = alone.predict(observation), robot.predict(observation)
        assert here.actions.tobytes() == there.actions.tobytes(), index
        assert (here.step_s, here.space, here.note) == (there.step_s, there.space, there.note)


def test_images_that_the_model_does_not_use_are_not_sent(
    served: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[list[str]] = []
    one = served()
    ask = PolicyClient.ask

    def watched(client: PolicyClient, observation: Document, deadline_s: float) -> Any:
        sent.append(list(observation[RESERVED]["frames"]))
        return ask(client, observation, deadline_s)

    monkeypatch.setattr(PolicyClient, "ask", watched)
    frame = SEEN.frames["primary"]
    one.predict(replace(SEEN, frames={"primary": frame, "wrist": frame, "top": frame}))
    assert sent == [["primary", "wrist"]]


def test_the_round_trip_is_split_up_by_one_clock(served: Robot) -> None:
    metrics = served(options={"took_s": 0.05}).predict(SEEN).metrics
    parts = [metrics[f"shared.{part}_ms"] for part in ("link", "queue", "model")]
    assert metrics["shared.model_ms"] >= 50.0
    assert min(parts) >= 0.0
    assert sum(parts) == pytest.approx(metrics["shared.round_trip_ms"])


def test_sockets_lie_where_only_this_user_can_reach_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    options = PolicyOptions(backend="reflex")
    folder = directory_of(options)
    assert folder == tmp_path / "roboneuron"
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)
    with pytest.raises(ConfigurationError, match="mode 700"):
        directory_of(options)


def test_robots_with_other_model_options_use_another_server() -> None:
    base = PolicyOptions(backend="oft", checkpoint="/models/a")
    assert (
        base.identity()
        == PolicyOptions(backend="oft", checkpoint="/models/a", timeout_s=0.2).identity()
    )
    for other in ({"checkpoint": "/models/b"}, {"options": {"profile": "libero"}}, {"most": 4}):
        assert base.identity() != base.model_copy(update=other).identity()


def test_the_command_serves_robots_of_the_same_configuration_until_it_is_ended(
    spawned: Robot, tmp_path: Path
) -> None:
    given = options_in(tmp_path, idle_s=30.0)
    environment = given["environment"]
    assert isinstance(environment, dict)
    lines = [f"{key} = {json.dumps(value)}" for key, value in given.items() if key != "environment"]
    lines += [
        "[plugins.shared.environment]",
        *(f"{key} = {json.dumps(value)}" for key, value in environment.items()),
    ]
    path = tmp_path / "roboneuron.toml"
    path.write_text('[robot]\nname = "any"\n[plugins.shared]\n' + "\n".join(lines))
    words = [sys.executable, "-m", "roboneuron.cli.main", "shared-model", "--config", str(path)]
    process = subprocess.Popen(words, env={**os.environ, **environment})
    try:
        wait_until(lambda: bool(list((tmp_path / "run").glob("*.sock"))), 90.0, "it listens")
        assert answers(spawned())
        assert servers_in(tmp_path) == [], "the robot has found it, and started none"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert list((tmp_path / "run").glob("*.sock")) == []
    finally:
        process.kill()
        process.wait()
