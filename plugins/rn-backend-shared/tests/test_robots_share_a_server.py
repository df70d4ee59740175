"""Real server processes: several robots on one, batches that are exact, and servers that die, fail
or hang.
"""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_shared import server as server_module
from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.case import install, options_in
from rn_backend_shared.frames import VERSION, Header, Kind
from rn_backend_shared.links import Links, directory_of
from rn_backend_shared.model import SharedModel
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.plugin import BACKEND
from rn_backend_shared.server import SharedModelServer
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import (
    ActionChunk,
    Ahead,
    CheckpointError,
    ConfigurationError,
    InvalidInputError,
    NotReadyError,
    Observation,
    RoboNeuronError,
)
from roboneuron.cli.main import main

pytestmark = pytest.mark.timeout(200)
SEEN = make_observation(BACKEND)
Robot = Callable[..., SharedBackend]


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    """Return a function that makes a loaded backend; their servers end with the test."""
    install(tmp_path)
    with ExitStack() as stack:

        def make(**options: Any) -> SharedBackend:
            given = options_in(tmp_path, **{"idle_s": 30.0, **options})
            made = SharedBackend(SharedOptions.model_validate(given))
            stack.callback(made.close)
            made.load()
            return made

        yield make
    for pid in servers_in(tmp_path):
        os.kill(pid, signal.SIGKILL)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Robot]:
    """As `robot`, with the server on a thread of this process: quicker, where no process has to
    die.
    """
    install(tmp_path)
    sys.path.insert(0, str(tmp_path / "site"))
    with ExitStack() as stack:
        started: dict[Path, threading.Thread] = {}

        def make(**options: Any) -> SharedBackend:
            made = SharedOptions.model_validate(options_in(tmp_path, **options))
            path = tmp_path / "run" / f"{made.identity()}-0.sock"
            if path not in started:
                server = SharedModelServer(made, path, None)
                started[path] = threading.Thread(target=server.run)
                started[path].start()
                stack.callback(started[path].join, 60.0)
                stack.callback(server.stop)
                wait_until(path.exists, 90.0, "the server listens")
            backend = SharedBackend(made)
            stack.callback(backend.close)
            backend.load()
            return backend

        yield make
    sys.path.remove(str(tmp_path / "site"))
    sys.modules.pop("rn_reflex_plugin", None)
    assert not servers_in(tmp_path), "nothing was spawned"


def servers_in(folder: Path) -> list[int]:
    """Server processes whose socket is in the folder."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = entry.read_bytes().split(b"\0")
        except OSError:
            continue
        if b"rn_backend_shared.server" in words and any(
            word.startswith(str(folder).encode()) for word in words
        ):
            found.append(int(entry.parent.name))
    return found


def seen(number: int) -> Observation:
    frame = SEEN.frames["primary"]
    image = np.full((48, 64, 3), 10 * number, dtype=np.uint8)
    return replace(
        SEEN, frames={"primary": replace(frame, image=image)}, instruction="x" * (number + 1)
    )


def answers(robot: SharedBackend) -> bool:
    try:
        robot.predict(SEEN)
    except NotReadyError:
        return False
    return True


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


def test_a_server_that_dies_is_a_clear_error_and_then_there_is_another(
    robot: Robot, tmp_path: Path
) -> None:
    one, other = robot(), robot()
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(NotReadyError, match="shared model"):
        one.predict(SEEN)
    wait_until(lambda: answers(one), 90.0, "another server answers")
    wait_until(lambda: answers(other), 90.0, "the other robot has found it too")
    wait_until(lambda: len(servers_in(tmp_path)) == 1, 90.0, "there is one of them")
    assert servers_in(tmp_path) != [pid]


@pytest.mark.slow
def test_with_a_replica_the_death_of_a_server_costs_no_more_than_the_chunk_under_way(
    robot: Robot, tmp_path: Path
) -> None:
    one = robot(replicas=2)
    wait_until(
        lambda: len(list((tmp_path / "run").glob("*.sock"))) == 2, 90.0, "both have a socket"
    )
    ready = Links(one._options)
    wait_until(lambda: all(ready._is_ready(path) for path in ready._paths), 90.0, "both are ready")
    ready.close()
    expected = one.predict(SEEN).actions
    told = one._links
    assert told is not None
    used = told._greet(told._paths[0])
    assert used is not None
    os.kill(used.pid, signal.SIGKILL)
    wait_until(lambda: used.pid not in servers_in(tmp_path), 90.0, "it is gone")
    lost = 0
    for _ in range(20):
        try:
            np.testing.assert_array_equal(one.predict(SEEN).actions, expected)
        except NotReadyError:
            lost += 1
    assert lost <= 1
    wait_until(lambda: len(servers_in(tmp_path)) == 2, 90.0, "it is replaced")


@pytest.mark.slow
def test_a_server_that_hangs_costs_no_more_than_the_deadline(robot: Robot, tmp_path: Path) -> None:
    one = robot(timeout_s=0.3)
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(NotReadyError, match="before the deadline"):
            one.predict(SEEN)
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 90.0, "it goes on; the late answer is thrown away")
    expected = [one.predict(seen(index)).actions for index in (1, 2)]
    assert not np.array_equal(*expected)


def test_why_a_model_cannot_be_loaded_is_told_as_its_backend_says_it(served: Robot) -> None:
    with pytest.raises(CheckpointError, match=r"There are no weights\. Copy some"):
        served(options={"fails": True})
    with pytest.raises(ConfigurationError, match="'absent'"):
        served(backend="absent")


def test_what_may_remember_robots_is_not_shared_unless_a_person_says_that_it_does_not(
    served: Robot,
) -> None:
    with pytest.raises(ConfigurationError, match="stateless = true"):
        served(backend="rememberer")
    assert served(backend="rememberer", stateless=True).predict(SEEN).metrics["shared.batch"] == 1.0


def test_a_server_without_robots_ends_and_leaves_no_socket(robot: Robot, tmp_path: Path) -> None:
    one = robot(idle_s=1.0)
    assert answers(one)
    one.close()
    wait_until(lambda: not servers_in(tmp_path), 90.0, "it ends")
    assert list((tmp_path / "run").glob("*.sock")) == []


def test_nonsense_on_the_socket_disturbs_nobody(served: Robot, tmp_path: Path) -> None:
    one = served()
    (path,) = (tmp_path / "run").glob("*.sock")
    body = json.dumps([{"observation": {}}, []]).encode()
    request = Header(Kind.REQUEST, 1, document_bytes=len(body)).pack()
    deep = b"[" * 100_000
    for nonsense in (
        b"\xff" * 64,
        b"GET / HTTP/1.1\r\n\r\n" * 2,
        request + body,
        request[:-1],
        Header(Kind.REQUEST, 1, document_bytes=len(deep)).pack() + deep,
        2 * (request + body),
        Header(Kind.REQUEST, 1, array_bytes=1 << 31).pack(),
        Header(Kind.ANSWER, 1).pack(),
    ):
        with socket.socket(socket.AF_UNIX) as wild:
            wild.settimeout(30.0)
            wild.connect(str(path))
            wild.sendall(nonsense)
            wild.shutdown(socket.SHUT_WR)
            while wild.recv(4096):
                pass
    assert answers(one)
    assert threading.active_count() < 50


def test_a_server_of_another_version_is_refused_in_words(
    served: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with socket.socket(socket.AF_UNIX) as newer:
        newer.settimeout(30.0)
        newer.connect(str(path))
        hello = bytearray(Header(Kind.HELLO).pack())
        hello[4] = VERSION + 1
        newer.sendall(hello)
        told = b""
        while part := newer.recv(4096):
            told += part
    assert f"version {VERSION + 1}".encode() in told
    assert f"version {VERSION}".encode() in told


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
    # that of another connection is none, though one of that number is held for it
    other.predict(SEEN)
    assert other.predict(replace(seen(3), ahead=ahead)).metrics["continues"] == -1.0
    # as is one that is no longer held
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
            model = SharedModel(SharedOptions.model_validate(options))
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
        sys.modules.pop("rn_reflex_plugin", None)


def test_raw_answers_equal_those_of_the_same_backend_here_bit_for_bit(
    served: Robot, tmp_path: Path
) -> None:
    robot = served(options={"rows": 6})
    reflex = importlib.import_module("rn_reflex_plugin")
    alone = reflex.Reflex(reflex.Options(rows=6))
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
    ask = one._links.ask  # type: ignore[union-attr]

    def watched(observation: Observation, deadline_s: float) -> Any:
        sent.append(list(observation.frames))
        return ask(observation, deadline_s)

    monkeypatch.setattr(one._links, "ask", watched)
    frame = SEEN.frames["primary"]
    one.predict(replace(SEEN, frames={"primary": frame, "wrist": frame, "top": frame}))
    assert sent == [["primary", "wrist"]]


def test_the_round_trip_is_split_up_by_one_clock(served: Robot) -> None:
    metrics = served(options={"took_s": 0.05}).predict(SEEN).metrics
    parts = [metrics[f"shared.{part}_ms"] for part in ("link", "queue", "model")]
    assert metrics["shared.model_ms"] >= 50.0
    assert min(parts) >= 0.0
    assert sum(parts) == pytest.approx(metrics["shared.round_trip_ms"])


def test_connections_that_say_nothing_keep_no_robot_out(served: Robot, tmp_path: Path) -> None:
    one = served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with ExitStack() as stack:
        crowd = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(200)]
        for silent in crowd:
            silent.connect(str(path))
        assert served().predict(SEEN).metrics["shared.batch"] == 1.0
        assert one.predict(SEEN).actions.size
        crowd[0].settimeout(20)
        assert crowd[0].recv(1) == b""  # the oldest gave way


def test_a_connection_without_a_first_request_ends(
    served: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "_FIRST_S", 0.05)
    served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with socket.socket(socket.AF_UNIX) as silent:
        silent.settimeout(20)
        silent.connect(str(path))
        assert silent.recv(1) == b""


def test_a_server_without_handles_serves_again_when_it_has_some(
    served: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = served()
    (path,) = (tmp_path / "run").glob("*.sock")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        crowd = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(5)]
        next_one = os.dup(0)
        os.close(next_one)
        resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, before[1]))
        try:
            for refused in crowd:
                refused.connect(str(path))
            assert one.predict(SEEN).actions.size  # who is connected is served
            wait_until(lambda: "cannot connect" in caplog.text, 20)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert served().predict(SEEN).actions.size
    assert caplog.text.count("cannot connect") < 5
    assert "Traceback" not in caplog.text


def test_sockets_lie_where_only_this_user_can_reach_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    options = SharedOptions(backend="reflex")
    folder = directory_of(options)
    assert folder == tmp_path / "roboneuron"
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)
    with pytest.raises(ConfigurationError, match="mode 700"):
        directory_of(options)


def test_robots_with_other_model_options_use_another_server() -> None:
    base = SharedOptions(backend="oft", checkpoint="/models/a")
    assert (
        base.identity()
        == SharedOptions(backend="oft", checkpoint="/models/a", timeout_s=0.2).identity()
    )
    for other in ({"checkpoint": "/models/b"}, {"options": {"profile": "libero"}}, {"most": 4}):
        assert base.identity() != base.model_copy(update=other).identity()


def test_the_command_serves_robots_of_the_same_configuration_until_it_is_ended(
    robot: Robot, tmp_path: Path
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
        assert answers(robot())
        assert servers_in(tmp_path) == [], "the robot has found it, and started none"
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
        assert list((tmp_path / "run").glob("*.sock")) == []
    finally:
        process.kill()
        process.wait()
    assert main([*words[3:], "--replica", "1"]) == 2
