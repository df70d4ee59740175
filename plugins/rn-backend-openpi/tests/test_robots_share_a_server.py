"""Several robots share one server process: each gets its own answer, in batches that are exact."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import SEEN, Robot, ahead_of, answers, seen, servers_in, toml_of

from rn_backend_openpi.case import Reflex, install, options_in
from rn_backend_openpi.client import PolicyClient
from rn_backend_openpi.links import socket_of
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.options import PolicyOptions
from rn_testing.waiting import wait_until
from roboneuron import (
    ActionChunk,
    Ahead,
    ConfigurationError,
    InvalidInputError,
    Observation,
    RoboNeuronError,
)

pytestmark = pytest.mark.timeout(200)


def test_robots_that_ask_at_once_share_one_batch_and_get_their_own_answer(
    served: Robot,
) -> None:
    robots = [served(options={"took_s": 0.05}, linger_s=0.1) for _ in range(6)]
    here, alone = Reflex(), [robots[0].predict(seen(index)).actions for index in range(6)]
    for index in range(6):
        assert alone[index].tobytes() == here.predict(seen(index)).actions.tobytes()
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


def test_sockets_lie_where_only_this_user_can_reach_them_one_for_each_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def path_of(**changes: object) -> Path:
        given = {"backend": "oft", "checkpoint": "/models/a", **changes}
        return socket_of(PolicyOptions.model_validate(given))

    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = path_of()
    assert path.parent == tmp_path / "roboneuron"
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert path_of(timeout_s=0.2) == path
    for other in ({"checkpoint": "/models/b"}, {"options": {"profile": "libero"}}, {"most": 4}):
        assert path_of(**other) != path
    path.parent.chmod(0o755)
    with pytest.raises(ConfigurationError, match="mode 700"):
        path_of()


def test_the_command_serves_robots_of_the_same_configuration_until_it_is_ended(
    spawned: Robot, tmp_path: Path
) -> None:
    given = options_in(tmp_path, idle_s=30.0)
    path = tmp_path / "roboneuron.toml"
    path.write_text(f'[robot]\nname = "any"\n[plugins]\nshared = {toml_of(given)}\n')
    words = [sys.executable, "-m", "roboneuron.cli.main", "policy", "share", "--config", str(path)]
    process = subprocess.Popen(words, env={**os.environ, **given["environment"]})
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


def test_rows_that_are_played_meanwhile_are_continued_with_the_context_that_the_server_holds(
    served: Robot,
) -> None:
    one, other = (served(options={"rows": 6}) for _ in range(2))
    first = one.predict(SEEN)
    after = replace(seen(3), ahead=ahead_of(first))
    told = one.predict(after)
    assert told.conditioned_rows == 3
    np.testing.assert_array_equal(told.actions[:3], first.actions[1:4])
    assert told.metrics["continues"] == 101.0, "the model has got its own context back"
    # a context of another connection is ignored, even if this one has a context of that number
    other.predict(SEEN)
    assert other.predict(after).metrics["continues"] == -1.0
    # likewise one that is no longer held
    for _ in range(8):
        one.predict(SEEN)
    assert one.predict(after).metrics["continues"] == -1.0


@pytest.mark.parametrize("continues", [True, False])
def test_a_batch_holds_those_whose_rows_do_not_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, continues: bool
) -> None:
    install(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    options = options_in(tmp_path, options={"rows": 6, "continues": continues})
    model, asked = SharedModel(PolicyOptions.model_validate(options)), list[int]()
    model.load()
    many = model._many
    assert many is not None

    def counted(observations: Sequence[Observation]) -> Any:
        asked.append(len(observations))
        return many(observations)

    model._many = counted
    ahead = Ahead(rows=np.zeros((4, 7)), committed_rows=3, step_s=0.1)
    given = [seen(0), replace(seen(1), ahead=ahead), seen(2)]
    told = [chunk for chunk in model.answer(given) if isinstance(chunk, ActionChunk)]
    assert [chunk.conditioned_rows for chunk in told] == [0, 3 if continues else 0, 0]
    assert asked == [2 if continues else 3]
    for chunk, one in zip(told, given, strict=True):
        (single,) = model.answer([one])
        assert isinstance(single, ActionChunk)
        if chunk.conditioned_rows == single.conditioned_rows:
            np.testing.assert_allclose(chunk.actions, single.actions, rtol=0, atol=1e-5)
