"""Starts franka-sim with our table and cubes, in its own environment: `python -m
rn_robot_fr3.fci.simulator`.

franka-sim 1.1.7 speaks protocol version 10 of the FCI and pins numpy 1.26, so it is installed
separately (`make .venv-fr3sim`), and runs `data/franka_sim_scene.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from types import TracebackType

from rn_robot_fr3.cell import FR3
from rn_robot_fr3.description import urdf
from rn_robot_fr3.fci.addresses import free_address
from rn_robot_fr3.fci.counterpart import Counterpart
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import FINGER_FRICTION, random_cubes
from rn_simulation.cubes import CUBE_FRICTION, DEFAULT_COLOURS, TABLE_FRICTION, WOOD_KG_M3

PORT, GRIPPER_PORT, SCENE_PORT = 1337, 1338, 1339


def scene(seed: int, colours: Sequence[str] = DEFAULT_COLOURS) -> dict[str, object]:
    """Data from which the simulator builds the same scene as the driver `simulated`."""
    return {
        "seed": seed,
        "urdf": urdf(),
        "home_rad": HOME_RAD,
        "cubes": [asdict(cube) for cube in random_cubes(seed, colours)],
        "table_size_m": FR3.table_size_m,
        "table_centre_m": FR3.table_centre_m,
        "table_friction": TABLE_FRICTION,
        "finger_friction": FINGER_FRICTION,
        "cube_friction": CUBE_FRICTION,
        "density_kg_m3": WOOD_KG_M3,
    }


class FrankaSim(Counterpart):
    """franka-sim with a scene. `tell(mode=...)` or `tell(error=...)` simulate a person at the arm
    or a reflex; see `data/franka_sim_scene.py`.

    Args:
        python: interpreter of the environment with franka-sim.
        options: further arguments, such as "--enforce-motion-limits".
        log: file for its output.
        port: UDP port of its scene.
        host: address to serve on; None chooses a free one of 127.0.0.0/8.
        prefix: prefix of its command, such as "nsenter" and its arguments.
    """

    name = "franka-sim"
    priority = 30

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
        super().__init__(host or free_address(PORT, GRIPPER_PORT, port), port, log)
        self._python = python
        self._prefix = prefix
        self._options = options
        self._seed = seed
        self._folder = tempfile.TemporaryDirectory(prefix="fr3sim-")

    def command(self) -> Sequence[str]:
        """The scene's script, in the environment with franka-sim."""
        path = Path(self._folder.name) / "scene.json"
        path.write_text(json.dumps(scene(self._seed)), encoding="utf-8")
        script = str(files("rn_robot_fr3").joinpath("data/franka_sim_scene.py"))
        address = ["--scene-port", str(self._asking_port), "--host", self.host]
        return [*self._prefix, str(self._python), script, str(path), *address, *self._options]

    def is_serving(self) -> bool:
        """True if the FCI's port is open."""
        with contextlib.closing(socket.create_connection((self.host, PORT), 2.0)):
            return True

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        super().__exit__(kind, error, trace)
        self._folder.cleanup()

    @property
    def scene_address(self) -> str:
        """host:port of its scene, for the driver's option `scene`."""
        return f"{self.host}:{self._asking_port}"


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
