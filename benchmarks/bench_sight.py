"""Benchmark: objects of locators against the simulator's truth, over many scenes.

python benchmarks/bench_sight.py --scenes 50 --engines pybullet mujoco --locators colours depth

With `--file` each scene is a line of a file, and a run goes on where the last one ended.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from rn_robot_fr3.cameras import cameras as fr3_cameras
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.cubes import RGBA_BY_COLOUR
from rn_simulation.engine import ENGINES, EngineChoice
from roboneuron import (
    CalibratedImage,
    ConfigurationError,
    Frame,
    ImageDetection,
    LocatedObject,
    place_detections,
)
from roboneuron.sight.colours import ColourLocator
from roboneuron.sight.depth import DepthLocator
from roboneuron.sight.segmentation import find_blob, visible_colours

SAME_M = 0.03
"""An object within this distance of a cube of its colour is that cube."""
SIZES = ((224, 224), (640, 480))
CAMERAS = {"both": ("front", "wrist"), "front": ("front",), "wrist": ("wrist",)}
NOISE, DEPTH_NOISE_M = 15.0, 0.002
"""Standard deviations of the noise of a pixel, of 255, and of depth at 1 m, which grows with the
square of the distance.
"""
LIGHT = (0.6, 0.45, 0.3)
"""Factors of red, green and blue in other light: a dim, warm lamp."""
DISPLACED_M = 0.02
POSTURE_RAD = (0.3, 0.25, 0.2, 0.25, 0.2, 0.2, 0.3)
"""The arm hides cubes: its joints are up to so far from home, the second one always forwards."""
DISTURBANCES = ("undisturbed", "displaced", "noise", "light", "occluded")


class BoxLocator:
    """Places boxes of coloured regions as those of a detector, without depth.

    Attributes:
        error_px: standard deviation of the edges of a box.
    """

    error_px = 1.0

    def __init__(self, config: None) -> None:
        self._random = np.random.default_rng(0)

    def load(self) -> None:
        """See `Locator`."""

    def locate(self, images: Sequence[CalibratedImage]) -> Sequence[LocatedObject]:
        """See `Locator`."""
        found = []
        for image in images:
            flat = replace(image, frame=replace(image.frame, depth_m=None))
            height, width = image.frame.image.shape[:2]
            for colour in visible_colours(image.frame.image):
                blob = find_blob(image.frame.image, colour)
                assert blob is not None
                low, high = blob.pixels.min(axis=0) - 0.5, blob.pixels.max(axis=0) + 0.5
                box = np.append(low, high) + self._random.normal(0.0, self.error_px, 4)
                box = np.clip(box, 0.0, [width, height, width, height])
                found.append(ImageDetection(image=flat, label=colour, score=1.0, box_px=box))
        return [replace(one, colour=one.label) for one in place_detections(found, usual_m=0.05)]


LOCATORS = {"colours": ColourLocator, "depth": DepthLocator, "boxes": BoxLocator}


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

    def merge(self, other: Tally) -> None:
        """Add the results of another one."""
        for one in fields(self):
            setattr(self, one.name, getattr(self, one.name) + getattr(other, one.name))

    def add(
        self, truth: dict[str, tuple[np.ndarray, float]], found: Sequence[LocatedObject]
    ) -> None:
        """Compare one scene: true centre and yaw by colour, with what was found."""
        self.cubes += len(truth)
        left = dict(truth)
        for one in found:
            name = one.colour or nearest(left, one)
            place = left.get(name)
            error_m = np.inf if place is None else float(np.linalg.norm(one.position_m - place[0]))
            if place is None or error_m > max(SAME_M, one.uncertainty_m):
                self.false += 1
                continue
            del left[name]
            self.within += error_m <= one.uncertainty_m
            self.errors_m.append(error_m)
            self.told_m.append(one.uncertainty_m)
            self.partly += not one.is_whole
            if one.yaw_rad is not None:
                turn = (one.yaw_rad - place[1] + np.pi / 4) % (np.pi / 2) - np.pi / 4
                self.turns_rad.append(abs(turn))
        self.missed += len(left)

    def row(self) -> dict[str, float | None]:
        """The figures."""
        errors, turns = np.array(self.errors_m) * 1e3, np.rad2deg(self.turns_rad)
        return {
            "scenes": len(self.took_s),
            "cubes": self.cubes,
            "error_median_mm": round(float(np.median(errors)), 2),
            "error_95_mm": round(float(np.percentile(errors, 95)), 2),
            "yaw_median_deg": round(float(np.median(turns)), 2) if len(turns) else None,
            "yaw_95_deg": round(float(np.percentile(turns, 95)), 2) if len(turns) else None,
            "told_median_mm": round(float(np.median(self.told_m)) * 1e3, 2),
            "within_told": round(self.within / max(1, len(self.errors_m)), 3),
            "partly": self.partly,
            "missed": self.missed,
            "false": self.false,
            "p95_ms": round(float(np.percentile(self.took_s, 95)) * 1e3, 1),
            "p95_cpu_ms": round(float(np.percentile(self.cpu_s, 95)) * 1e3, 1),
        }


def nearest(truth: dict[str, tuple[np.ndarray, float]], one: LocatedObject) -> str:
    """Name of the nearest cube; empty without any."""
    far_m = {name: np.linalg.norm(place - one.position_m) for name, (place, _) in truth.items()}
    return min(far_m, key=far_m.__getitem__, default="")


def pictures(
    simulation: ArmSimulation, size: tuple[int, int], disturbance: str
) -> list[CalibratedImage]:
    """Render calibrated pictures with depth."""
    random = np.random.default_rng(simulation.seed)
    made = []
    for camera in fr3_cameras():
        image, depth_m = simulation.render_depth(camera.name, *size)
        if disturbance == "noise":
            off_m = random.normal(0.0, DEPTH_NOISE_M, depth_m.shape) * depth_m**2
            depth_m = (depth_m + off_m).astype(np.float32)
            image = (image + random.normal(0.0, NOISE, image.shape)).clip(0, 255).astype(np.uint8)
        if disturbance == "light":
            image = (image * np.array(LIGHT)).astype(np.uint8)
        calibration = camera.calibration(*size)
        mount = np.eye(4) if calibration.arm is None else simulation.world.T_base_tcp(0)
        frame = Frame(
            camera=camera.name,
            image=image,
            stamp_ns=1,
            frame_id=camera.frame_id,
            calibration=calibration,
            depth_m=depth_m,
        )
        made.append(CalibratedImage(frame=frame, T_base_camera=mount @ calibration.T_mount_camera))
    return made


@contextmanager
def scene(engine: EngineChoice, seed: int, disturbance: str) -> Iterator[ArmSimulation | None]:
    """Open the simulation of a random scene; None if its cubes find no room on the table."""
    random = np.random.default_rng([seed, 49])
    colours = random.permutation(sorted(RGBA_BY_COLOUR))[: random.integers(1, 6)].tolist()
    off_m = DISPLACED_M if disturbance == "displaced" else 0.0
    moved = [camera.displaced((off_m, 0.0, 0.0)) for camera in fr3_cameras()]
    try:
        made = ArmSimulation(seed, colours=colours, engine=engine, cameras=moved)
    except ConfigurationError:
        yield None
        return
    with made as simulation:
        simulation.step(60)
        if disturbance == "occluded":
            turn = random.uniform(-1.0, 1.0, len(POSTURE_RAD)) * POSTURE_RAD
            turn[1] = abs(turn[1])
            joints = simulation.joint_positions().copy()
            joints[: len(turn)] += turn
            simulation.place(joints, simulation.world.cube_poses())
        yield simulation


def truth_of(simulation: ArmSimulation) -> dict[str, tuple[np.ndarray, float]]:
    """True centre and yaw by colour."""
    yaws = {cube.name: cube.yaw_rad for cube in simulation.scene}
    return {name: (one.position_m, yaws[name]) for name, one in simulation.cubes().items()}


def look(
    simulation: ArmSimulation,
    disturbance: str,
    sizes: Iterable[tuple[int, int]],
    views: Iterable[str],
    kinds: Iterable[str],
) -> dict[str, Tally]:
    """Results of one scene, by condition."""
    truth, found = truth_of(simulation), {}
    for size in sizes:
        images = pictures(simulation, size, disturbance)
        for name, kind in itertools.product(views, kinds):
            chosen = [image for image in images if image.frame.camera in CAMERAS[name]]
            locator = LOCATORS[kind](None)
            locator.load()
            tally = Tally()
            began_s, cpu_s = time.perf_counter(), time.process_time()
            objects = locator.locate(chosen)
            tally.took_s.append(time.perf_counter() - began_s)
            tally.cpu_s.append(time.process_time() - cpu_s)
            tally.add(truth, objects)
            found[f"{kind} {disturbance} {name} {size[0]}x{size[1]}"] = tally
    return found


def main() -> None:
    """Run and print one line for each condition."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--engines", nargs="+", default=ENGINES, choices=ENGINES)
    parser.add_argument("--disturbances", nargs="+", default=DISTURBANCES, choices=DISTURBANCES)
    parser.add_argument("--locators", nargs="+", default=list(LOCATORS), choices=LOCATORS)
    parser.add_argument("--cameras", nargs="+", default=list(CAMERAS), choices=CAMERAS)
    parser.add_argument("--large", action="store_true", help="pictures of 640 x 480 only")
    parser.add_argument("--minutes", type=float, default=np.inf, help="most time of this run")
    parser.add_argument("--file", type=Path, help="a line for each scene; a run goes on with it")
    arguments = parser.parse_args()
    tallies: dict[str, Tally] = {}
    done = read(arguments.file, tallies)
    end_s = time.monotonic() + 60 * arguments.minutes
    sizes = SIZES[1:] if arguments.large else SIZES
    seeds = range(arguments.first, arguments.first + arguments.scenes)
    for seed, engine, disturbance in itertools.product(
        seeds, arguments.engines, arguments.disturbances
    ):
        key = f"{seed} {engine} {disturbance}"
        if key in done:
            continue
        if time.monotonic() > end_s:
            break
        with scene(engine, seed, disturbance) as simulation:
            if simulation is None:
                continue
            one = look(simulation, disturbance, sizes, arguments.cameras, arguments.locators)
        found = {f"{engine} {name}": tally for name, tally in one.items()}
        add(tallies, found)
        if arguments.file:
            line = {"key": key, "found": {name: asdict(tally) for name, tally in found.items()}}
            with arguments.file.open("a") as file:
                file.write(json.dumps(line) + "\n")
    for name in sorted(tallies):
        print(name, json.dumps(tallies[name].row()), flush=True)


def add(tallies: dict[str, Tally], found: dict[str, Tally]) -> None:
    """Add the results of one scene."""
    for name, tally in found.items():
        tallies.setdefault(name, Tally()).merge(tally)


def read(file: Path | None, tallies: dict[str, Tally]) -> set[str]:
    """Take over what earlier runs have found; returns the keys of their scenes."""
    done = set()
    for line in file.read_text().splitlines() if file and file.exists() else ():
        one = json.loads(line)
        done.add(one["key"])
        add(tallies, {name: Tally(**tally) for name, tally in one["found"].items()})
    return done


if __name__ == "__main__":
    main()
