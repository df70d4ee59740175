"""Benchmark: objects of the locator `colours` against the simulator's truth, over many scenes.

python benchmarks/bench_sight.py --scenes 50 --engines pybullet mujoco
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rn_robot_fr3.cameras import cameras as fr3_cameras
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.cubes import RGBA_BY_COLOUR
from rn_simulation.engine import ENGINES, EngineChoice
from rn_standard.sight.colours import ColourLocator
from rn_standard.sight.locator import CalibratedImage, LocatedObject
from roboneuron import ConfigurationError, Frame

SAME_M = 0.03
"""An object within this distance of a cube of its colour is that cube."""
SIZES = ((224, 224), (640, 480))
CAMERAS = {"both": ("front", "wrist"), "front": ("front",), "wrist": ("wrist",)}
NOISE = 6.0
"""Standard deviation of the noise of a pixel, of 255, with --noise."""


@dataclass
class Tally:
    """Results of one condition."""

    errors_m: list[float] = field(default_factory=list)
    turns_rad: list[float] = field(default_factory=list)
    told_m: list[float] = field(default_factory=list)
    within: int = 0
    cubes: int = 0
    partly: int = 0
    missed: int = 0
    false: int = 0
    took_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)

    def add(
        self, truth: dict[str, tuple[np.ndarray, float]], found: Sequence[LocatedObject]
    ) -> None:
        """Compare one scene: true centre and yaw by colour, with what was found."""
        self.cubes += len(truth)
        left = dict(truth)
        for one in found:
            place = left.get(one.colour)
            error_m = np.inf if place is None else float(np.linalg.norm(one.position_m - place[0]))
            if place is None or error_m > max(SAME_M, one.uncertainty_m):
                self.false += 1
                continue
            del left[one.colour]
            self.within += error_m <= one.uncertainty_m
            self.errors_m.append(error_m)
            self.told_m.append(one.uncertainty_m)
            self.partly += not one.is_whole
            if one.yaw_rad is not None:
                turn = (one.yaw_rad - place[1] + np.pi / 4) % (np.pi / 2) - np.pi / 4
                self.turns_rad.append(abs(turn))
        self.missed += len(left)

    def row(self) -> dict[str, float]:
        """The figures."""
        errors, turns = np.array(self.errors_m) * 1e3, np.rad2deg(self.turns_rad)
        return {
            "scenes": len(self.took_s),
            "cubes": self.cubes,
            "error_median_mm": round(float(np.median(errors)), 2),
            "error_95_mm": round(float(np.percentile(errors, 95)), 2),
            "yaw_median_deg": round(float(np.median(turns)), 2),
            "yaw_95_deg": round(float(np.percentile(turns, 95)), 2),
            "told_median_mm": round(float(np.median(self.told_m)) * 1e3, 2),
            "within_told": round(self.within / max(1, len(self.errors_m)), 3),
            "partly": self.partly,
            "missed": self.missed,
            "false": self.false,
            "p95_ms": round(float(np.percentile(self.took_s, 95)) * 1e3, 1),
            "p95_cpu_ms": round(float(np.percentile(self.cpu_s, 95)) * 1e3, 1),
        }


def pictures(
    simulation: ArmSimulation, cameras: Sequence[str], size: tuple[int, int], noise: float
) -> list[CalibratedImage]:
    """Render calibrated pictures."""
    random = np.random.default_rng(simulation.seed)
    made = []
    for camera in fr3_cameras():
        if camera.name not in cameras:
            continue
        image = simulation.render(camera.name, *size)
        if noise:
            image = (image + random.normal(0.0, noise, image.shape)).clip(0, 255).astype(np.uint8)
        calibration = camera.calibration(*size)
        mount = np.eye(4) if calibration.arm is None else simulation.world.T_base_tcp(0)
        frame = Frame(
            camera=camera.name,
            image=image,
            stamp_ns=1,
            frame_id=camera.frame_id,
            calibration=calibration,
        )
        made.append(CalibratedImage(frame=frame, T_base_camera=mount @ calibration.T_mount_camera))
    return made


def scenes(
    engine: EngineChoice, count: int, first: int, displaced_m: float
) -> Iterator[tuple[ArmSimulation, dict[str, tuple[np.ndarray, float]]]]:
    """Open simulations of random scenes, with true centre and yaw by colour."""
    moved = [camera.displaced((displaced_m, 0.0, 0.0)) for camera in fr3_cameras()]
    for seed in range(first, first + count):
        random = np.random.default_rng([seed, 49])
        colours = random.permutation(sorted(RGBA_BY_COLOUR))[: random.integers(1, 6)].tolist()
        try:
            yaws = {cube.name: cube.yaw_rad for cube in random_cubes(seed, colours)}
        except ConfigurationError:  # too many for the table
            continue
        with ArmSimulation(seed, colours=colours, engine=engine, cameras=moved) as simulation:
            simulation.step(60)
            cubes = simulation.cubes()
            yield simulation, {n: (c.position_m, yaws[n]) for n, c in cubes.items()}


def main() -> None:
    """Run and print one line for each condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--engines", nargs="+", default=ENGINES, choices=ENGINES)
    parser.add_argument("--noise", type=float, default=0.0, help=f"of a pixel, such as {NOISE}")
    parser.add_argument("--displaced-m", type=float, default=0.0, help="of the front camera")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    tallies: dict[str, Tally] = {}
    try:
        for engine in arguments.engines:
            play(arguments, engine, tallies)
    except KeyboardInterrupt:
        print("ended early; so far:")
    rows = {name: tally.row() for name, tally in tallies.items()}
    for name, row in rows.items():
        print(name, json.dumps(row), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def play(arguments: argparse.Namespace, engine: EngineChoice, tallies: dict[str, Tally]) -> None:
    """Look at the scenes of one engine, and add what was found."""
    locator = ColourLocator(None)
    locator.load()
    drawn = scenes(engine, arguments.scenes, arguments.first, arguments.displaced_m)
    for simulation, truth in drawn:
        for size in SIZES:
            images = pictures(simulation, CAMERAS["both"], size, arguments.noise)
            for name, cameras in CAMERAS.items():
                chosen = [image for image in images if image.frame.camera in cameras]
                tally = tallies.setdefault(f"{engine} {name} {size[0]}x{size[1]}", Tally())
                began_s, cpu_s = time.perf_counter(), time.process_time()
                found = locator.locate(chosen)
                tally.took_s.append(time.perf_counter() - began_s)
                tally.cpu_s.append(time.process_time() - cpu_s)
                tally.add(truth, found)


if __name__ == "__main__":
    main()
