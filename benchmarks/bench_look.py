"""Benchmark: time of the tool `look` in a served FR3, with each locator.

python benchmarks/bench_look.py --calls 60 --locators colours depth http-locator
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
import numpy as np
from PIL import Image

from rn_simulation.engine import ENGINES
from rn_testing.agent import Agent, client_of
from rn_testing.domain import free_ros_domain
from rn_testing.fakes.locating_server import LocatingServer
from roboneuron.sight.segmentation import find_blob, visible_colours

CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[control]
controller = "urdf"
[sight]
locator = "{locator}"
[plugins.fr3-sim-camera]
width = 640
height = 480
depth = {depth}
[plugins.fr3]
engine = "{engine}"
{options}
[supervisor]
start_timeout_s = 180.0
state_directory = "{state}"
"""
WITH_DEPTH = ("depth",)
LOCATORS = ("colours", "depth", "http-locator")
_LONGEST_S = 600.0


def coloured_boxes(request: dict[str, Any]) -> dict[str, Any]:
    """What a model that boxes coloured objects answers."""
    found = []
    for part in request["images"]:
        pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(part["data"]))))
        for colour in visible_colours(pixels):
            blob = find_blob(pixels, colour)
            assert blob is not None
            edges = np.concatenate([blob.pixels.min(axis=0) - 0.5, blob.pixels.max(axis=0) + 0.5])
            found.append({"camera": part["camera"], "label": colour, "box": edges.tolist()})
    return {"detections": found}


async def measure(agent: Agent, calls: int) -> dict[str, Any]:
    """Time of each call as its client sees it, with pictures and without, and what is found."""
    for kind in ("robot", "perception", "control"):
        await agent.do(f"start_{kind}")
    took_s: dict[str, list[float]] = {"with pictures": [], "list only": []}
    found = set()
    for number in range(calls + 1):
        for name, pictures in (("with pictures", True), ("list only", False)):
            began_s = time.perf_counter()
            seen = await agent.do("look", pictures=pictures)
            if number:  # the first loads the locator
                took_s[name].append(time.perf_counter() - began_s)
            found.add(len(seen["objects"]))
    row: dict[str, Any] = {"objects": sorted(found), "problems": seen["problems"]}
    for name, times in took_s.items():
        row[name] = {
            "median_ms": round(float(np.median(times)) * 1e3),
            "p95_ms": round(float(np.percentile(times, 95)) * 1e3),
        }
    return row


def main() -> None:
    """Run and print one line for each locator."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calls", type=int, default=60)
    parser.add_argument("--engine", default="pybullet", choices=ENGINES)
    parser.add_argument("--locators", nargs="+", default=LOCATORS, choices=LOCATORS)
    arguments = parser.parse_args()
    for locator in arguments.locators:
        with tempfile.TemporaryDirectory() as folder, LocatingServer() as server:
            server.answer = coloured_boxes
            options = f'[plugins.http-locator]\nurl = "{server.url}"'
            config = Path(folder) / "roboneuron.toml"
            depth = str(locator in WITH_DEPTH).lower()
            config.write_text(
                CONFIG.format(
                    locator=locator,
                    depth=depth,
                    engine=arguments.engine,
                    options=options if locator == "http-locator" else "",
                    state=f"{folder}/state",
                )
            )
            environment = {
                **os.environ,
                "ROS_DOMAIN_ID": str(free_ros_domain()),
                "XDG_STATE_HOME": folder,
            }

            async def scenario(
                config: Path = config, environment: dict[str, str] = environment
            ) -> dict[str, Any]:
                async with client_of(config, environment, "--log-level", "error") as client:
                    with anyio.fail_after(_LONGEST_S):
                        return await measure(Agent(client), arguments.calls)

            print(locator, json.dumps(anyio.run(scenario)), f"load {os.getloadavg()[0]:.0f}")


if __name__ == "__main__":
    main()
