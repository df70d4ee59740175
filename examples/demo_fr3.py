"""The demo with the driver `fci`: franka-sim holds table, cubes and arm; cameras, control and
policy are unchanged.

Run it with `make demo-fr3`; further arguments go to `roboneuron demo`.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
from pathlib import Path

from rn_robot_fr3.fci.simulator import FrankaSim

CONFIG = Path(__file__).with_name("fr3_fci.toml")
PLACE = "127.0.0.1"
"""Address in the configuration; each demo replaces it by its own, so that several run on one
machine.
"""


def main() -> int:
    """Start the simulator and run the demo; return 0 if the cube was lifted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--python", type=Path, default=Path(".venv-fr3sim/bin/python"), help="has franka-sim"
    )
    parser.add_argument("--scene", type=int, default=None, help="which scene; default: a new one")
    parser.add_argument("--output", type=Path, default=Path("out/demo-fr3"))
    arguments, more = parser.parse_known_args()
    seed = random.SystemRandom().randrange(10_000) if arguments.scene is None else arguments.scene
    with FrankaSim(arguments.python, seed=seed, log=arguments.output / "franka-sim.log") as sim:
        print(f"franka-sim: scene {seed}, FCI protocol 10 on {sim.host}", flush=True)
        config = arguments.output / "fr3_fci.toml"
        config.write_text(
            CONFIG.read_text(encoding="utf-8").replace(PLACE, sim.host), encoding="utf-8"
        )
        command = [sys.executable, "-m", "roboneuron.cli.main", "demo", "--config", str(config)]
        return subprocess.run(
            [*command, "--out", str(arguments.output), *more], check=False
        ).returncode


if __name__ == "__main__":
    sys.exit(main())
