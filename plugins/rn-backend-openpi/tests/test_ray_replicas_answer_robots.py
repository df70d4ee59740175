"""`roboneuron policy serve --engine ray`: replicas on a real Ray cluster of this machine behind one
address.
"""

from __future__ import annotations

import builtins
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from openpi_clients import http_get
from policy_servers import SEEN, RunningServer, ahead_of, robot_of, seen

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import Reflex, ReflexOptions
from rn_backend_openpi.ray_engine import RayModel, ray_models
from rn_backend_openpi.serve_command import name_of
from rn_backend_openpi.server_options import RayOptions, ReplicaOptions, ServedModelOptions
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError, MissingDependencyError, NotReadyError
from roboneuron.command import discover

ROBOTS = 16
RAY = {"least": 2, "most": 3, "cpus": 0.1}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    """Two replicas, a third under load, on a cluster that ends with the module."""
    pytest.importorskip("ray.serve", reason="needs rn-backend-openpi[ray]", exc_type=ImportError)
    folder = tmp_path_factory.mktemp("ray")
    # not in the folder: Ray's sockets have long names
    held = tempfile.mkdtemp(prefix="ray-")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", held)
        patch.setenv("HOME", held)  # for the token of the cluster
        listen = {"keys": "token", "token_file": str(folder / "token"), "drain_s": 30.0}
        models = {"only": {"options": {"rows": 6, "took_s": 0.05}, "ray": RAY, "most": 2}}
        made = RunningServer(folder, models, listen).start("--engine", "ray")
    try:
        yield made
    finally:
        made.end()
        shutil.rmtree(held, ignore_errors=True)


@pytest.fixture
def robots(server: RunningServer) -> Iterator[list[PolicyBackend]]:
    """Loaded backends of many robots."""
    token = str(server.folder / "token")
    made = [robot_of(server.address, token_file=token, coding="raw") for _ in range(ROBOTS)]
    for one in made:
        one.load()
    yield made
    for one in made:
        one.close()


def replicas_of(server: RunningServer) -> list[int]:
    """Processes of the replicas."""
    name = f"{name_of(server.config)}-only"
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes()
        except OSError:
            continue
        if words.startswith(b"ray::ServeReplica:") and name.encode() in words:
            found.append(int(entry.parent.name))
    return found


@pytest.mark.slow
def test_answers_are_those_of_the_same_backend_here_bit_for_bit(
    server: RunningServer, robots: list[PolicyBackend], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(server.folder / "site"))
    alone = Reflex(ReflexOptions(rows=6))
    alone.load()
    with ThreadPoolExecutor(ROBOTS) as pool:
        told = list(pool.map(lambda i: robots[i].predict(seen(i)), range(ROBOTS)))
    for number, chunk in enumerate(told):
        here = alone.predict(seen(number)).actions
        np.testing.assert_allclose(chunk.actions, here, atol=1e-12)  # a batch is one product
    assert http_get(f"ws://{server.address}", "/healthz") == (200, b"OK\n")


@pytest.mark.slow
def test_a_robot_keeps_the_replica_that_holds_its_context(robots: list[PolicyBackend]) -> None:
    """Another replica has no context and would answer with -1."""
    for one in robots[:6]:
        first = one.predict(SEEN)
        for _ in range(4):
            told = one.predict(replace(SEEN, instruction="x", ahead=ahead_of(first)))
            assert told.conditioned_rows == 3
            assert told.metrics["continues"] > 0.0


@pytest.mark.slow
def test_replicas_killed_in_turn_cost_no_answer(
    server: RunningServer, robots: list[PolicyBackend]
) -> None:
    end, lost, longest_s = threading.Event(), [0] * ROBOTS, [0.0] * ROBOTS

    def drive(number: int) -> None:
        answered_s = time.monotonic()
        while not end.wait(0.1):
            try:
                robots[number].predict(SEEN)
            except NotReadyError:
                lost[number] += 1
                continue
            longest_s[number] = max(longest_s[number], time.monotonic() - answered_s)
            answered_s = time.monotonic()

    with ThreadPoolExecutor(ROBOTS) as pool:
        driving = [pool.submit(drive, number) for number in range(ROBOTS)]
        try:
            for _ in range(2):
                wait_until(lambda: _running(server) >= 2, 60.0, "two replicas run")
                os.kill(replicas_of(server)[0], signal.SIGKILL)
                end.wait(2.0)  # the others answer meanwhile
            wait_until(lambda: _running(server) >= 2, 60.0, "they were started again")
        finally:
            end.set()
        for one in driving:
            one.result(30.0)
    assert sum(lost) == 0, (lost, longest_s)
    assert max(longest_s) < 10.0
    assert server.status()["models"]["only"]["lost"] == 0


@pytest.mark.slow
def test_a_replica_is_added_when_observations_wait(server: RunningServer) -> None:
    token = str(server.folder / "token")
    made = [robot_of(server.address, token_file=token, coding="raw") for _ in range(ROBOTS)]
    end = threading.Event()

    def drive(one: PolicyBackend) -> None:
        one.load()
        while not end.is_set():
            one.predict(SEEN)
        one.close()

    with ThreadPoolExecutor(ROBOTS) as pool:
        driving = [pool.submit(drive, one) for one in made]
        try:
            wait_until(lambda: _running(server) == 3, 90.0, "a third replica runs")
        finally:
            end.set()
        for one in driving:
            one.result(30.0)


@pytest.mark.slow
def test_a_server_that_is_stopped_answers_those_that_are_connected(
    server: RunningServer, robots: list[PolicyBackend]
) -> None:
    url = f"ws://{server.address}"
    os.kill(server.pid, signal.SIGTERM)
    wait_until(lambda: http_get(url, "/healthz")[0] == 503, 10.0, "a balancer is told")
    assert robots[0].predict(SEEN).actions.shape == (6, 7)
    token = str(server.folder / "token")
    late = robot_of(server.address, token_file=token, start_timeout_s=0.5)
    with pytest.raises(NotReadyError, match="is being stopped"):
        late.load()
    for one in robots:
        one.close()
    assert server.end() == 0
    assert not replicas_of(server)


def test_a_missing_ray_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    ordinary = builtins.__import__

    def without(name: str, *rest: Any, **named: Any) -> Any:
        if name.partition(".")[0] == "ray":
            raise ImportError("No module named 'ray'")
        return ordinary(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match="--engine ray needs Ray Serve") as refusal:
        ray_models(RayOptions()).__enter__()
    assert refusal.value.hint == 'pip install "ray[serve]"'


def test_what_replicas_cannot_have_is_refused() -> None:
    registry = discover()
    named = ServedModelOptions(backend="dummy", python=Path("/opt/its/bin/python"))
    with pytest.raises(ConfigurationError, match="names a `python`"):
        RayModel("only", named, "policies-only", registry)
    with pytest.raises(ConfigurationError, match="There is no backend 'mars'"):
        RayModel("only", ServedModelOptions(backend="mars"), "policies-only", registry)
    with pytest.raises(ValueError, match="least = 3 replicas is more than most = 2"):
        ReplicaOptions(least=3, most=2)


def _running(server: RunningServer) -> int:
    return int(server.status()["models"]["only"]["replicas"].get("RUNNING", 0))
