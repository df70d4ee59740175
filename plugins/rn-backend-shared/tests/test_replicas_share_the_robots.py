"""Several processes under the name of one model: robots are distributed over them, stay with the
one that holds their chunks, and continue with another when one dies.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import RunningServer, robot_of

from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.options import PolicyServerOptions, ServedModelOptions
from rn_backend_shared.plugin import BACKEND
from rn_backend_shared.processes import ModelProcess
from rn_backend_shared.replicas import Replicas
from rn_backend_shared.serve_command import table_of
from rn_backend_shared.session import READY, Welcome
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import ActionChunk, Ahead, ConfigurationError, NotReadyError
from roboneuron.cli.main import main

pytestmark = pytest.mark.timeout(200)
SEEN = make_observation(BACKEND)
Serve = Callable[..., RunningServer]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Return a function that starts a server with two replicas of one model."""
    with ExitStack() as stack:

        def start(*words: str, **options: Any) -> RunningServer:
            listen = {"keys": "token", "token_file": str(tmp_path / "token")}
            made = RunningServer(tmp_path, {"only": {"replicas": 2, **options}}, listen)
            stack.callback(made.end)
            made.start(*words)
            wait_until(lambda: len(ready(made)) == 2, 60.0, "both replicas are ready")
            return made

        yield start


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Callable[..., SharedBackend]]:
    """Return a function that creates a loaded backend of a robot."""
    with ExitStack() as stack:

        def make(server: RunningServer, **options: Any) -> SharedBackend:
            token = str(tmp_path / "token")
            made = robot_of(server.address, token_file=token, coding="raw", **options)
            stack.callback(made.close)
            made.load()
            return made

        yield make


def replicas_of(server: RunningServer) -> list[dict[str, Any]]:
    return list(server.status()["models"]["only"]["replicas"])


def ready(server: RunningServer) -> list[int]:
    """Pids of the ready replicas."""
    return [one["pid"] for one in replicas_of(server) if one["state"] == "ready"]


def robots_at(server: RunningServer) -> list[int]:
    return [one.get("clients", 0) for one in replicas_of(server)]


def test_robots_are_spread_and_answered_alike(
    serve: Serve, robot: Callable[..., SharedBackend], capsys: pytest.CaptureFixture[str]
) -> None:
    server = serve()
    robots = [robot(server) for _ in range(4)]
    chunks = [one.predict(SEEN) for one in robots]
    assert robots_at(server) == [2, 2]
    assert len({chunk.actions.tobytes() for chunk in chunks}) == 1
    status = server.status()
    assert status["models"]["only"]["answered"] == 4
    rows = [line.split()[0] for line in table_of(status).splitlines()[2:]]
    assert rows == ["only", "only.0", "only.1"]


def test_a_replica_that_is_killed_while_it_computes_costs_at_most_an_error(
    serve: Serve, robot: Callable[..., SharedBackend]
) -> None:
    server = serve(options={"took_s": 1.0})
    robots = [robot(server, timeout_s=15.0) for _ in range(2)]
    before = ready(server)
    answers: list[ActionChunk | NotReadyError] = []

    def ask(one: SharedBackend) -> None:
        try:
            answers.append(one.predict(SEEN))
        except NotReadyError as error:
            answers.append(error)

    threads = [threading.Thread(target=ask, args=(one,)) for one in robots]
    begun_s = time.monotonic()
    for thread in threads:
        thread.start()
    wait_until(lambda: all(one["busy_s"] > 0.0 for one in replicas_of(server)), 20.0, "they do")
    os.kill(before[0], signal.SIGKILL)
    for thread in threads:
        thread.join(30.0)
    assert time.monotonic() - begun_s < 15.0
    # the other replica has answered both
    assert [type(answer) for answer in answers] == [ActionChunk, ActionChunk]
    wait_until(lambda: len(ready(server)) == 2, 60.0, "it is started again")
    assert set(ready(server)) != set(before)
    assert server.status()["models"]["only"]["restarts"] == 1


def test_robots_come_back_to_a_replica_that_was_started_again(
    serve: Serve, robot: Callable[..., SharedBackend]
) -> None:
    server = serve(options={"continues": False})
    robots = [robot(server) for _ in range(4)]
    for one in robots:
        one.predict(SEEN)
    os.kill(ready(server)[0], signal.SIGKILL)
    for one in robots:
        one.predict(SEEN)
    wait_until(lambda: len(ready(server)) == 2, 60.0, "it is started again")

    def evened_out() -> bool:
        for one in robots:
            one.predict(SEEN)
        return robots_at(server) == [2, 2]

    wait_until(evened_out, 30.0, "two robots at each")


def test_a_robot_whose_rows_go_on_stays_where_their_context_is(
    serve: Serve, robot: Callable[..., SharedBackend]
) -> None:
    server = serve(options={"rows": 6})
    robots = [robot(server) for _ in range(4)]
    chunks = [one.predict(SEEN) for one in robots]
    for one in robots[:1] + robots[2:3]:  # both of one replica
        one.close()
    wait_until(lambda: sorted(robots_at(server)) == [0, 2], 30.0)
    for one, chunk in list(zip(robots, chunks, strict=True))[1::2]:
        ahead = Ahead(
            rows=chunk.actions[1:],
            committed_rows=3,
            step_s=0.1,
            context=chunk.context,
            context_row=1,
        )
        told = one.predict(replace(SEEN, instruction="x", ahead=ahead))
        assert told.metrics["continues"] > 0.0, "the context was found"
        np.testing.assert_array_equal(told.actions[:3], chunk.actions[1:4])


def welcomed(monkeypatch: pytest.MonkeyPatch, *, continues: bool) -> Replicas:
    """Two replicas without processes, both ready."""
    told = Welcome(state=READY, pid=1, continues=continues)

    class Silent:
        def close(self) -> None:
            pass

    monkeypatch.setattr(ModelProcess, "state", READY)
    monkeypatch.setattr(ModelProcess, "connect", lambda process, hello: (Silent(), told))
    given = ServedModelOptions.model_validate({"backend": "oft", "replicas": 2})
    return Replicas("only", given, Path("/nowhere"), "x")


@pytest.mark.parametrize("continues", [False, True])
def test_a_robot_moves_only_where_nothing_of_it_is_held(
    monkeypatch: pytest.MonkeyPatch, continues: bool
) -> None:
    model = welcomed(monkeypatch, continues=continues)
    seats = [model.take_seat({}) for _ in range(4)]
    assert [seat.replica for seat in seats] == [0, 1, 0, 1]
    assert not any(seat.is_crowded for seat in seats)
    seats[1].leave()
    seats[3].leave()
    assert seats[0].is_crowded is not continues
    assert model.take_seat({}, avoided=1).replica == 0


def test_each_replica_has_its_own_gpu_and_socket() -> None:
    given = {"backend": "oft", "replicas": 2, "gpus": ["0", "1"], "environment": {"A": "b"}}
    options = ServedModelOptions.model_validate(given)
    seen = [options.of_replica(number).environment for number in range(2)]
    assert [one["CUDA_VISIBLE_DEVICES"] for one in seen] == ["0", "1"]
    assert all(one["A"] == "b" for one in seen)
    names = [process.path.name for process in Replicas("a", options, Path("/x"), "p").processes]
    assert names == ["p-a.0.sock", "p-a.1.sock"]
    with pytest.raises(ValueError, match="gpus names 1 for 2 replicas"):
        ServedModelOptions.model_validate({**given, "gpus": ["0"]})


def test_the_command_line_sets_the_count_of_one_model_or_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, given = tmp_path / "policies.toml", list[PolicyServerOptions]()
    token = f"keys = 'token'\ntoken_file = '{tmp_path}/t'\ndirectory = '{tmp_path}/run'"
    path.write_text(f"[listen]\n{token}\n[models.a]\nbackend='oft'\n[models.b]\nbackend='oft'\n")

    def run(self: object, options: PolicyServerOptions, *_: object) -> None:
        given.append(options)
        raise ConfigurationError("enough")

    monkeypatch.setattr("rn_backend_shared.front.PolicyServer.__init__", run)
    words = ["serve-policy", "--config", str(path)]
    for extra in (["--replicas", "2"], ["--replicas", "3", "--model", "b"]):
        assert main([*words, *extra]) != 0
    counts = [[one.replicas for one in options.models.values()] for options in given]
    assert counts == [[2, 2], [1, 3]]
    for wrong, expected in (
        (["--model", "b"], "goes with --replicas"),
        (["--replicas", "2", "--model", "c"], "no model 'c'"),
        (["--replicas", "99"], "replicas"),
    ):
        assert main([*words, *wrong]) != 0
        assert expected in capsys.readouterr().err
