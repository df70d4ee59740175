"""Episodes on Ray: same results as in one process, whatever is killed; a shared policy answers in
batches.
"""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter

import psutil
import pytest

from rn_eval.ledger import FILE_NAME, read_records
from rn_testing.waiting import wait_until

pytest.importorskip("ray", reason="needs the extra rn-eval[ray]")
KILLS = int(os.environ.get("ROBONEURON_EVAL_KILLS", "50"))
LIMIT_S = 3600
pytestmark = [pytest.mark.slow, pytest.mark.timeout(LIMIT_S)]


def command(folder, *words):
    return [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "eval",
        "run",
        "--suite",
        "toy",
        "--backend",
        "steer",
        "--out",
        str(folder),
        "--strips",
        "none",
        *words,
    ]


def finish(folder, *words):
    done = subprocess.run(
        command(folder, *words), capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    return done


def refused(folder, *words):
    """Error of a run with two episodes and two workers that is refused."""
    done = subprocess.run(
        command(folder, "--episodes", "2", "--workers", "2", *words),
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 2
    return done.stderr


def outcomes(folder):
    return {record.key: record.outcome for record in read_records(folder)}


def test_two_workers_give_what_one_gives(toy, tmp_path):
    words = (
        "--episodes",
        "12",
        "--latency",
        "lognormal:112ms,0.3",
        "--execution",
        "sequential,overlap",
    )
    finish(tmp_path / "one", *words)
    finish(tmp_path / "two", *words, "--workers", "2")
    assert outcomes(tmp_path / "one") == outcomes(tmp_path / "two")
    assert len({record.pid for record in read_records(tmp_path / "two")}) == 2


@pytest.fixture
def cluster(toy, tmp_path, monkeypatch):
    """Address of a separate Ray cluster with two CPUs."""
    import ray

    # otherwise it depends on whether this user has a token
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    # Ray replaces 127.0.0.1 by it
    address, log = f"{ray.util.get_node_ip_address()}:{port}", tmp_path / "ray.log"
    # Not below pytest's folder, because Ray's sockets are there, and their paths are limited to 107
    # characters.
    with tempfile.TemporaryDirectory(prefix="ray-") as folder:
        words = ("--head", "--block", f"--port={port}", "--num-cpus=2", "--disable-usage-stats")
        with log.open("w") as output:
            head = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "ray.scripts.scripts",
                    "start",
                    f"--temp-dir={folder}",
                    *words,
                ],
                stdout=output,
                stderr=output,
            )
        try:
            until_s = time.monotonic() + 120.0
            while "runtime started" not in log.read_text(encoding="utf-8"):
                assert time.monotonic() < until_s, log.read_text(encoding="utf-8")
                assert head.poll() is None, log.read_text(encoding="utf-8")
                time.sleep(0.2)
            yield address
        finally:
            children = (
                psutil.Process(head.pid).children(recursive=True) if head.poll() is None else []
            )
            head.terminate()
            for process in psutil.wait_procs(children, timeout=20.0)[1]:
                process.kill()
            head.wait(20)


def test_a_cluster_does_what_one_process_does_and_is_used_only_when_named(
    cluster, tmp_path, monkeypatch
):
    finish(tmp_path / "one", "--episodes", "6")
    finish(tmp_path / "named", "--episodes", "6", "--workers", "2", "--ray-address", cluster)
    assert outcomes(tmp_path / "one") == outcomes(tmp_path / "named")
    # Ray would use it by default; it has no room for three workers
    monkeypatch.setenv("RAY_ADDRESS", cluster)
    finish(tmp_path / "local", "--episodes", "6", "--workers", "3")
    assert outcomes(tmp_path / "one") == outcomes(tmp_path / "local")


def test_a_cluster_that_is_not_there_is_told(toy, tmp_path):
    said = refused(tmp_path, "--ray-address", "127.0.0.1:9")
    assert "There is no Ray cluster at '127.0.0.1:9'" in said
    assert "Traceback" not in said


def test_an_episode_that_ends_its_worker_is_an_error_and_the_others_go_on(toy, tmp_path):
    done = finish(tmp_path, "--episodes", "6", "--workers", "2", "--suite-option", "deadly=4")
    statuses = {key.seed: outcome.status for key, outcome in outcomes(tmp_path).items()}
    assert done.returncode == 1
    assert statuses[4] == "error"
    assert len(statuses) == 6
    assert Counter(statuses.values())["error"] == 1


def _processes(driver, name):
    try:
        found = psutil.Process(driver.pid).children(recursive=True)
        return [p for p in found if any(name in word for word in p.cmdline()[:1])]
    except psutil.Error:
        return []


def test_kills_of_workers_driver_and_ray_lose_no_episode_and_run_none_twice(toy, tmp_path):
    """Whatever is killed, the same command then runs exactly the missing episodes."""
    words = ("--episodes", "400", "--suite-option", "slow_s=0.3")
    chance = random.Random(13)
    killed: Counter[str] = Counter()
    begun_s = time.monotonic()
    driver = None
    while killed.total() < KILLS and time.monotonic() - begun_s < LIMIT_S:
        if driver is None or driver.poll() is not None:
            driver = subprocess.Popen(
                command(tmp_path, *words, "--workers", "2"),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
        count = len(_lines(tmp_path))
        wait_until(
            lambda d=driver, c=count: len(_lines(tmp_path)) > c or d.poll() is not None, 600.0
        )
        time.sleep(chance.uniform(0.0, 0.5))
        kind = chance.choices(("ray::EpisodeWorker", "driver", "raylet"), (10, 1, 1))[0]
        found = [psutil.Process(driver.pid)] if kind == "driver" else _processes(driver, kind)
        if found and driver.poll() is None:
            chance.choice(found).kill()
            killed[kind] += 1
    if driver is not None and driver.poll() is None:
        driver.kill()
    if driver is not None:
        driver.wait()
    print(dict(killed), f"{len(_lines(tmp_path))} episodes, {time.monotonic() - begun_s:.0f} s")
    assert killed.total() == KILLS
    # episodes that were hit three times by chance
    deadly = sum(line["outcome"]["status"] == "error" for line in _lines(tmp_path))
    finish(tmp_path, "--episodes", "400", "--suite-option", "slow_s=0.3", "--retry-errors")
    records = read_records(tmp_path)
    assert sorted(record.key.seed for record in records) == list(range(400))
    assert len(_lines(tmp_path)) == 400 + deadly
    assert all(record.outcome.status != "error" for record in records)


def _lines(folder):
    path = folder / FILE_NAME
    return (
        [
            json.loads(line)
            for line in path.read_text().splitlines(keepends=True)
            if line.endswith("\n")
        ]
        if path.exists()
        else []
    )


def test_a_shared_policy_answers_many_workers_at_once(toy, tmp_path):
    done = finish(
        tmp_path,
        "--backend",
        "steer-batch",
        "--episodes",
        "12",
        "--workers",
        "3",
        "--policy-actors",
        "1",
    )
    assert done.returncode == 0
    finish(tmp_path / "own", "--backend", "steer-batch", "--episodes", "12")
    assert outcomes(tmp_path) == outcomes(tmp_path / "own")


SHARED = ("--backend", "steer-batch", "--episodes", "30", "--suite-option", "slow_s=0.3")


@pytest.mark.parametrize("name", ["ray::EpisodeWorker", "ray::PolicyActor"])
@pytest.mark.parametrize("way", [signal.SIGSTOP, signal.SIGKILL])
def test_a_frozen_process_is_replaced_as_a_dead_one_is(toy, tmp_path, name, way):
    log = tmp_path / "driver.log"
    with log.open("w") as output:
        driver = subprocess.Popen(
            command(tmp_path / "run", *SHARED, "--workers", "2", "--policy-actors", "1"),
            stdout=output,
            stderr=output,
        )
    wait_until(lambda: len(_lines(tmp_path / "run")) > 3 or driver.poll() is not None, 600.0)
    found = _processes(driver, name)
    assert found, log.read_text(encoding="utf-8")
    os.kill(found[0].pid, way)
    assert driver.wait(600) == 0
    finish(tmp_path / "own", *SHARED)
    assert outcomes(tmp_path / "run") == outcomes(tmp_path / "own")


def test_a_policy_that_remembers_cannot_be_shared(toy, tmp_path):
    assert "offers no predict_batch" in refused(tmp_path, "--policy-actors", "1")


def test_a_gpu_that_is_not_there_is_refused(toy, tmp_path):
    """Ray would wait for it forever."""
    assert "2000 GPUs are needed" in refused(tmp_path, "--policy-gpus", "1000")
