"""Starts franka-sim with our table and cubes, in an environment of its own: `python -m
rn_robot_fr3.fci.simulator`.

franka-sim 1.1.7 speaks protocol version 10 of the FCI and pins numpy 1.26, so it is installed apart
(`make .venv-fr3sim`). What it runs there is `data/franka_sim_scene.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from types import TracebackType
from typing import Any

from rn_robot_fr3.description import urdf
from rn_robot_fr3.fci.addresses import free_address
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import DEFAULT_COLOURS, random_cubes
from rn_robot_fr3.world import (
    CUBE_FRICTION,
    FINGER_FRICTION,
    TABLE_CENTRE_M,
    TABLE_FRICTION,
    TABLE_SIZE_M,
    WOOD_KG_M3,
)
from roboneuron import NotReadyError

PORT, GRIPPER_PORT, SCENE_PORT = 1337, 1338, 1339
_START_S = 60.0
_STOP_S = 20.0
_PRIORITY = 30


def scene(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> dict[str, Any]:
    """What the simulator needs to build the same scene as the driver `simulated`."""
    return {
        "seed": seed,
        "urdf": urdf(),
        "home_rad": HOME_RAD,
        "cubes": [asdict(cube) for cube in random_cubes(seed, colours)],
        "table_size_m": TABLE_SIZE_M,
        "table_centre_m": TABLE_CENTRE_M,
        "table_friction": TABLE_FRICTION,
        "finger_friction": FINGER_FRICTION,
        "cube_friction": CUBE_FRICTION,
        "density_kg_m3": WOOD_KG_M3,
    }


class FrankaSim:
    """franka-sim as a child process; a context manager.

    Args:
        python: interpreter of the environment that has franka-sim.
        options: further arguments, such as "--enforce-motion-limits".
        log: where its output goes.
        port: UDP port of its scene.
        host: address that it serves on; none chooses one of 127.0.0.0/8 that is free.
        prefix: what its command begins with, such as "nsenter" and its arguments.

    Attributes:
        host: address that it serves on.
        process: the child, once it is started.
    """

    def __init__(
        self,
        python: Path,
        *,
        seed: int = 0,
        options: Sequence[str] = (),
        log: Path,
        port: int = SCENE_PORT,
        host: str | None = None,
        prefix: Sequence[str] = (),
    ) -> None:
        self._python = python
        self.host = host or free_address(PORT, GRIPPER_PORT, port)
        self._prefix = prefix
        self._options = options
        self._seed = seed
        self._log = log
        self._port = port
        self._folder = tempfile.TemporaryDirectory(prefix="fr3sim-")
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> FrankaSim:
        path = Path(self._folder.name) / "scene.json"
        path.write_text(json.dumps(scene(self._seed)), encoding="utf-8")
        script = str(files("rn_robot_fr3").joinpath("data/franka_sim_scene.py"))
        ours = [
            str(self._python),
            script,
            str(path),
            "--scene-port",
            str(self._port),
            "--host",
            self.host,
        ]
        command = [*self._prefix, *ours, *self._options]
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("wb") as output:
            self.process = subprocess.Popen(
                command, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
            )
        # a control box has a computer of its own: let it not wait for others here
        with contextlib.suppress(OSError):
            os.sched_setscheduler(self.process.pid, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        deadline_s = time.monotonic() + _START_S
        while not self._answers():
            if self.process.poll() is not None or time.monotonic() > deadline_s:
                self.__exit__(None, None, None)
                tail = self._log.read_text(encoding="utf-8", errors="replace")[-800:]
                raise NotReadyError(f"franka-sim did not start: {tail}")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        process = self.process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._folder.cleanup()

    @property
    def scene_address(self) -> str:
        """host:port of its scene, as the driver's option `scene` has it."""
        return f"{self.host}:{self._port}"

    def tell(self, **what: int) -> dict[str, Any]:
        """Ask for the scene; with mode= or error= play the person at the arm, or a reflex. Raises
        OSError.
        """
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
            asking.settimeout(2.0)
            asking.connect((self.host, self._port))
            asking.send(json.dumps(what).encode())
            answer: dict[str, Any] = json.loads(asking.recv(65536))
            return answer

    def _answers(self) -> bool:
        try:
            return bool(self.tell()) and self._listens()
        except OSError:
            time.sleep(0.2)
            return False

    def _listens(self) -> bool:
        with contextlib.closing(socket.create_connection((self.host, PORT), 2.0)):
            return True


def main() -> int:
    """Run until interrupted."""
    parser = argparse.ArgumentParser(description="franka-sim with a table and cubes.")
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help="address to serve on; another one for a second simulator",
    )
    parser.add_argument("--python", type=Path, default=Path(".venv-fr3sim/bin/python"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", type=Path, default=Path("out/franka-sim.log"))
    arguments, options = parser.parse_known_args()
    with FrankaSim(
        arguments.python,
        seed=arguments.seed,
        options=options,
        log=arguments.log,
        host=arguments.host,
    ) as sim:
        print(
            f"franka-sim serves scene {arguments.seed} on {sim.host}; log: {arguments.log}",
            flush=True,
        )
        assert sim.process is not None
        with contextlib.suppress(KeyboardInterrupt):
            sim.process.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main())
