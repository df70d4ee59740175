"""Cost of Ray Serve between robots and a model, compared with RoboNeuron's server of one machine,
and what robots miss when models are killed.

    python benchmarks/bench_ray_policy.py [--rounds 300] [--side 224]

Needs `rn-backend-openpi[ray]`. A backend that computes nothing gets requests with one raw image
from one robot, interleaved: over `roboneuron policy serve` with a process, and with one replica on
a Ray cluster of this machine. Both admit by token, over the loopback interface without TLS.

Then 16 robots ask 10 times a second a backend that takes 20 ms for each batch. Its model is killed
twice: the one process, which is started again; two replicas in turn. A chunk holds 16 rows of
0.05 s, counted from its request: a row is missed if its time has passed when the next answer comes.
"""

from __future__ import annotations

import argparse
import logging
import os
import shutil
import signal
import statistics
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from bench_serve_policy import ROWS, SOURCE, STEP_S, Ask, measure, seen, started

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.serve_command import name_of
from rn_backend_openpi.statistics import ask_status
from rn_testing.fakes.site import PluginSite
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, Observation

ROBOTS, PERIOD_S, KILLS, BATCH_S = 16, 0.1, 2, 0.02
ENGINES = ("processes", "ray")
SLOW = SOURCE.replace(
    "        chunk =", f"        import time; time.sleep({BATCH_S})\n        chunk ="
).replace("null-benchmark", "slow-benchmark")


class Server:
    """`roboneuron policy serve` with one engine.

    Args:
        stack: ends it.
        folder: for its files; made.
        engine: of `--engine`.
        backend: of its model.
        replicas: of the model, with Ray.
    """

    def __init__(
        self, stack: ExitStack, folder: Path, engine: str, backend: str, replicas: int
    ) -> None:
        folder.mkdir()
        (folder / "run").mkdir(mode=0o700)
        self._config, self._folder, self._engine = folder / "policies.toml", folder, engine
        self._count = replicas
        self.token = folder / "token"
        self._config.write_text(
            f'[listen]\nport = 0\ndirectory = "{folder / "run"}"\nkeys = "token"\n'
            f'token_file = "{self.token}"\n[models.one]\nbackend = "{backend}"\n'
            f"ray = {{ least = {replicas}, most = {replicas}, cpus = 0.1 }}\n"
        )
        log = stack.enter_context((folder / "server.log").open("w"))
        words = ["policy", "serve", "--config", str(self._config), "--engine", engine]
        started(
            stack, [sys.executable, "-m", "roboneuron.cli.main", *words], stdout=log, stderr=log
        )
        wait_until(self.is_ready, 120.0, f"the server with {engine} is ready")

    def status(self) -> dict[str, Any]:
        """Of the server."""
        return ask_status(self._folder / "run" / f"{name_of(self._config)}.sock")

    def is_ready(self) -> bool:
        """True if the model answers."""
        try:
            return bool(self.status()["models"]["one"]["state"] == "ready")
        except NotReadyError:
            return False

    def robot(self, stack: ExitStack) -> PolicyBackend:
        """A loaded backend."""
        made = PolicyBackend(
            PolicyOptions(
                address=self.status()["address"],
                token_file=self.token,
                coding="raw",
                timeout_s=1.5,
                start_timeout_s=60.0,
            )
        )
        stack.callback(made.close)
        made.load()
        return made

    def is_whole(self) -> bool:
        """True if the model answers, and all its replicas run."""
        if self._engine == "processes":
            return self.is_ready()
        running = self.status()["models"]["one"]["replicas"].get("RUNNING", 0)
        return bool(running == len(self._replicas()) == self._count)

    def kill(self) -> None:
        """Kill the process of the model, or of one replica."""
        if self._engine == "processes":
            os.kill(self.status()["models"]["one"]["pid"], signal.SIGKILL)
        else:
            os.kill(self._replicas()[0], signal.SIGKILL)

    def _replicas(self) -> list[int]:
        name, found = f"{name_of(self._config)}-one".encode(), []
        for entry in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):
                words = entry.read_bytes()
                if words.startswith(b"ray::ServeReplica:") and name in words:
                    found.append(int(entry.parent.name))
        return found


def main() -> int:
    """Run it; exit status 0 unless something fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--side", type=int, default=224, help="of the image [px]")
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # robots tell of each kill
    observation = seen(given.side)
    print(f"{given.side}x{given.side}, {given.rounds} rounds, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, held = Path(name), tempfile.mkdtemp(prefix="ray-")
        stack.callback(shutil.rmtree, held, ignore_errors=True)
        site = PluginSite(path=folder / "site")
        site.install("rn-null-benchmark", SOURCE, header="")
        site.install("rn-slow-benchmark", SLOW, header="")
        path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
        os.environ |= {"PYTHONPATH": path, "RAY_TMPDIR": held, "HOME": held}
        with ExitStack() as one:
            ways: dict[str, Ask] = {}
            for engine in ENGINES:
                server = Server(one, folder / f"cost-{engine}", engine, "null-benchmark", 1)
                robot = server.robot(one)
                ways[engine] = lambda robot=robot: robot.predict(observation)  # type: ignore[misc]
            show_costs(measure(ways, given.rounds))
        for engine in ENGINES:
            with ExitStack() as one:
                server = Server(one, folder / f"kills-{engine}", engine, "slow-benchmark", 2)
                show_kills(engine, server, [server.robot(one) for _ in range(ROBOTS)], observation)
    return 0


def show_costs(took_ms: dict[str, list[float]]) -> None:
    """Print the time of a request, and the ratio of Ray's to the other's."""
    found = {}
    for engine, times in took_ms.items():
        found[engine] = statistics.median(times), sorted(times)[int(0.99 * len(times))]
        print(f"{engine:<10} p50 {found[engine][0]:6.2f} ms, p99 {found[engine][1]:6.2f} ms")
    ratios = [ray / own for ray, own in zip(found["ray"], found["processes"], strict=True)]
    print(f"ray to processes: p50 {ratios[0]:.1f}, p99 {ratios[1]:.1f}")


def show_kills(
    engine: str, server: Server, robots: list[PolicyBackend], observation: Observation
) -> None:
    """Kill models while robots ask, and print what was lost."""
    end = threading.Event()
    gaps_s: list[list[float]] = [[] for _ in robots]
    lost = [0] * len(robots)

    def drive(number: int) -> None:
        begun_s = time.monotonic()
        while not end.wait(PERIOD_S):
            asked_s = time.monotonic()
            try:
                robots[number].predict(observation)
            except NotReadyError:
                lost[number] += 1
                continue
            gaps_s[number].append(time.monotonic() - begun_s)
            begun_s = asked_s

    with ThreadPoolExecutor(len(robots)) as pool:
        driving = [pool.submit(drive, number) for number in range(len(robots))]
        for _ in range(KILLS):
            end.wait(5.0)
            server.kill()
            end.wait(2.0)  # until the death is noticed
            wait_until(server.is_whole, 120.0, "the model is whole again")
        end.wait(10.0)
        end.set()
        for one in driving:
            one.result(timeout=60.0)
    missed = sum(
        max(0, int((gap_s - ROWS * STEP_S) / STEP_S)) for robot in gaps_s for gap_s in robot
    )
    answers = sum(map(len, gaps_s))
    longest_s = max(gap_s for robot in gaps_s for gap_s in robot)
    print(
        f"{engine:<10} {len(robots)} robots, {KILLS} kills: {answers} answers, {sum(lost)} "
        f"observations without an answer, {missed} rows missed, next answer after at most "
        f"{longest_s:.2f} s"
    )


if __name__ == "__main__":
    sys.exit(main())
