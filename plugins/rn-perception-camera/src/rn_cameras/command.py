"""The command `roboneuron robot cameras`."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, cast

from roboneuron import (
    CameraProfile,
    ConfigurationError,
    Controller,
    ControllerSpec,
    InvalidInputError,
    JointSample,
    Pose,
    RobotProfile,
    foreign,
)
from roboneuron.command import discover, load_config, poses_of
from roboneuron.feature import Config, Registry, build, load_profile

if TYPE_CHECKING:
    from rn_cameras.board import Board
    from rn_cameras.calibrating import Calibrated, Forward
    from rn_cameras.pictures import PictureFolder

CONFIG = Path("roboneuron.toml")
_INSTALL = "pip install opencv-python-headless scipy tomlkit"


class Cameras:
    """List cameras with a picture of each, print a calibration board, calibrate a camera."""

    def configure(self, parser: ArgumentParser) -> None:
        """Arguments of `roboneuron robot cameras`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="what to do (each: --help)"
        )
        listing = actions.add_parser("list", help="every camera, with a picture of each")
        _add_config(listing, "a roboneuron.toml, for the configured cameras")
        listing.add_argument(
            "--out", type=Path, default=Path("cameras"), help="folder for the pictures"
        )
        listing.add_argument("--json", action="store_true", help="for programs")
        board = actions.add_parser("board", help="print the board that calibrate looks for")
        board.add_argument("file", type=Path, metavar="FILE", help="a .pdf or .png to write")
        board.add_argument("--paper", choices=("a4", "a3", "letter"), default="a4")
        _add_board(board)
        calibrate = actions.add_parser(
            "calibrate", help="measure lens and pose of a camera, and write them into the file"
        )
        calibrate.add_argument("name", metavar="NAME", help="a camera of the robot")
        calibrate.add_argument(
            "--setup",
            required=True,
            choices=("eye-in-hand", "eye-to-hand", "corners"),
            help="eye-in-hand: the camera is on the hand, the board lies anywhere; eye-to-hand: "
            "the camera stands, the hand holds the board; corners: the camera stands, and the TCP "
            "touches the corners of the board that lies before it, or --corner tells them",
        )
        _add_config(calibrate, "the roboneuron.toml to write into; ./roboneuron.toml without it")
        calibrate.add_argument("--robot", default="", help="of a file with several robots")
        calibrate.add_argument("--arm", default="", help="of a robot with several; the first one")
        calibrate.add_argument(
            "--images",
            type=Path,
            metavar="DIR",
            help="use the pictures of this folder instead of taking some",
        )
        calibrate.add_argument(
            "--out", type=Path, metavar="DIR", help="folder for new pictures; calibration-NAME"
        )
        calibrate.add_argument(
            "--corner",
            type=_corner,
            action="append",
            default=[],
            metavar="N=X,Y,Z",
            help="position of outer corner N in the base frame [m]; three or four times",
        )
        calibrate.add_argument("--dry-run", action="store_true", help="write no configuration")
        _add_board(calibrate)

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron robot cameras`."""
        if arguments.action == "list":
            return _list(arguments)
        _check_installed()
        from rn_cameras.board import Board, print_board

        board = Board(
            columns=arguments.columns, rows=arguments.rows, square_m=arguments.square_mm / 1000
        )
        if arguments.action == "calibrate":
            return _calibrate(arguments, board)
        print_board(board, arguments.file, arguments.paper)
        _say(
            f"{arguments.file}: print it at 100 %, glue it to something flat, and measure the line "
            "and a square."
        )
        return 0


def _add_config(parser: ArgumentParser, meaning: str) -> None:
    parser.add_argument("--config", type=Path, metavar="FILE", help=meaning)


def _add_board(parser: ArgumentParser) -> None:
    parser.add_argument("--columns", type=int, default=8, help="squares of the board across")
    parser.add_argument("--rows", type=int, default=6, help="squares of the board down")
    parser.add_argument(
        "--square-mm", type=float, default=30.0, help="edge of a square [mm], as measured"
    )


def _corner(text: str) -> tuple[int, tuple[float, float, float]]:
    number, _, place = text.partition("=")
    try:
        x, y, z = (float(part) for part in place.split(","))
    except ValueError as error:
        raise ArgumentTypeError(f"{text!r} is not like 1=0.4,-0.1,0.0") from error
    if number not in ("1", "2", "3", "4") or not all(map(isfinite, (x, y, z))):
        raise ArgumentTypeError(f"{text!r} is no corner 1 to 4 at a place")
    return int(number), (x, y, z)


def _check_installed() -> None:
    """Raise MissingDependencyError for libraries of the extra `calibration`."""
    from importlib.util import find_spec

    from roboneuron import MissingDependencyError

    absent = [name for name in ("cv2", "scipy", "tomlkit") if find_spec(name) is None]
    if absent:
        raise MissingDependencyError(
            f"Calibration needs {', '.join(absent)}, which is not installed.", hint=_INSTALL
        )


def _say(line: str) -> None:
    """Print a line, which may hold words of devices, nodes and files."""
    sys.stdout.write(f"{foreign.printable(line, 2000)}\n")
    sys.stdout.flush()


def _ask(question: str) -> str:
    """A person's answer; END at the end of the input."""
    from rn_cameras.collecting import END

    try:
        return input(question).strip().lower()
    except EOFError:
        return END


def _list(arguments: Namespace) -> int:
    from rn_cameras import listing
    from rn_cameras.live import joined

    folder: Path = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    path = arguments.config or (CONFIG if CONFIG.exists() else None)
    config = None if path is None else load_config(path)
    each = [] if config is None else [*config.robots.values()] or [config]
    with joined() as link:
        found: list[listing.ListedCamera] = []
        for own in each:
            found += listing.configured_cameras(
                own, discover(own.disabled_plugins, own.robot), link, folder
            )
        found += listing.device_cameras(folder, each)
        found += listing.topic_cameras(link, folder)
    if arguments.json:
        sys.stdout.write(json.dumps([asdict(one) for one in found], indent=2) + "\n")
    else:
        for one in found:
            _say(f"{one.kind:<10}  {one.name}  ({one.about})")
            size = "" if one.size is None else f"{one.size[0]}x{one.size[1]}  "
            _say(f"{'':<10}  {size}{folder / one.picture if one.picture else one.problem}")
        good = sum(not one.problem for one in found)
        _say(f"{len(found)} cameras, {good} with a picture in {folder}.")
    return int(any(one.problem for one in found if one.kind == "configured"))


def _calibrate(arguments: Namespace, board: Board) -> int:
    from rn_cameras import writing
    from rn_cameras.calibrating import calibrate
    from rn_cameras.pictures import PictureFolder

    path: Path = arguments.config or CONFIG
    text = writing.read(path)
    config = _of_robot(load_config(path), arguments.robot)
    registry = discover(config.disabled_plugins, config.robot)
    profile = load_profile(registry, config.robot.name)
    camera = profile.camera(arguments.name)
    if camera is None:
        names = ", ".join(one.name for one in profile.cameras) or "none"
        raise ConfigurationError(
            f"Robot {profile.name!r} has no camera {arguments.name!r}; its cameras are {names}."
        )
    mount, forward = _kinematics(config, registry, profile, arguments)
    folder = PictureFolder(arguments.images or arguments.out or Path(f"calibration-{camera.name}"))
    if corners := dict(arguments.corner):
        if len(corners) < 3:
            raise InvalidInputError(f"--corner tells {len(corners)} corners, 3 are needed.")
        folder.note(folder.measured().model_copy(update={"corners": corners}))
    if arguments.images is None:
        _collect(arguments, board, config, registry, profile, camera, folder, forward)
    made = calibrate(folder, board, arguments.setup, forward)
    _report(made, camera.name)
    if made.refusal:
        _say(f"Not written: {made.refusal}.")
        return 1
    source = "" if config.perception is None else config.perception.source
    new = writing.written(text, camera.name, source, mount, made, robot=arguments.robot)
    if arguments.dry_run:
        return 0
    writing.replace_file(path, new)
    load_config(path)
    _say(f"Written into {path}: [robot.cameras.{camera.name}].")
    return 0


def _of_robot(config: Config, robot: str) -> Config:
    """The configuration of one robot. Raises ConfigurationError."""
    if not config.robots and not robot:
        return config
    if robot not in config.robots:
        raise ConfigurationError(
            f"--robot {robot!r}: the file has {', '.join(config.robots) or 'one robot, [robot]'}.",
            hint="Name the robot of the camera with --robot." if config.robots else "",
        )
    return config.robots[robot]


def _kinematics(
    config: Config, registry: Registry, profile: RobotProfile, arguments: Namespace
) -> tuple[str, Forward]:
    """Mount of the camera, and what computes the TCP of the arm. Raises RoboNeuronError."""
    arms = {arm.name: number for number, arm in enumerate(profile.each_arm)}
    chosen = arguments.arm or next(iter(arms))
    if chosen not in arms:
        raise ConfigurationError(f"--arm {chosen!r}: the robot has {', '.join(map(repr, arms))}.")
    mount = "base"
    if arguments.setup == "eye-in-hand":
        mount = f"{chosen}/tcp" if arms[chosen] else "tcp"
    loaded: list[Controller] = []

    def forward(joints: Mapping[str, float]) -> Pose:
        import numpy as np

        if not loaded:
            loaded.append(_controller(config, registry, profile))
        sample = JointSample(names=tuple(joints), position=np.array(list(joints.values())))
        return poses_of(loaded[0])(sample)[arms[chosen]]

    return mount, forward


def _controller(config: Config, registry: Registry, profile: RobotProfile) -> Controller:
    """The controller that computes where the TCP is. Raises RoboNeuronError."""
    installed = sorted(registry.specs(ControllerSpec))
    if config.control is not None:
        installed = [config.control.controller]
    if len(installed) != 1:
        raise ConfigurationError(
            "The configuration names no controller, which computes the TCP from joints; installed "
            f"are {', '.join(installed) or 'none'}.",
            hint='Name one: [control] with controller = "urdf" (rn-controller-urdf).',
        )
    spec = registry.get(ControllerSpec, installed[0])
    # distances to obstacles are not asked for
    bare = replace(profile, collision=None)
    controller = cast("Controller", build(spec, config.options(spec.name), bare))
    controller.load()
    return controller


def _collect(
    arguments: Namespace,
    board: Board,
    config: Config,
    registry: Registry,
    profile: RobotProfile,
    camera: CameraProfile,
    folder: PictureFolder,
    forward: Forward,
) -> None:
    """Take the pictures. Raises RoboNeuronError."""
    from rn_cameras.collecting import Collector
    from rn_cameras.live import ArmJoints, joined, opened

    needs_arm = arguments.setup != "corners" or not arguments.corner
    with ExitStack() as stack:
        link = stack.enter_context(joined())
        take = stack.enter_context(opened(config, registry, link, camera, is_raw=True))
        joints = None
        if needs_arm:
            joints = ArmJoints(link, config, profile)
            stack.callback(joints.close)
        _say(f"Pictures are kept in {folder.path}. This command never moves the robot.")
        collector = Collector(folder, board, take, joints, _ask, _say)
        collector.collect(arguments.setup, forward)


def _report(made: Calibrated, camera: str) -> None:
    """Tell what was measured, and how well."""
    import numpy as np

    for name, reason in made.left_out.items():
        _say(f"left out: {name}: {reason}")
    optics, pose = made.optics, made.camera
    fx, fy, cx, cy = optics.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    told = f"{optics.error_px:.2f} px" if made.is_optics_measured else "told by its driver"
    _say(f"{camera}: lens {fx:.1f} {fy:.1f} {cx:.1f} {cy:.1f} ({told})")
    x_m, y_m, z_m = pose.T_mount_camera[:3, 3].tolist()
    _say(f"{camera}: at {x_m:.4f} {y_m:.4f} {z_m:.4f} m in the frame of its mount")
    if made.corners_m is not None:
        _say(f"touched corners fit the board to {made.corners_m * 1000:.1f} mm")
    _say(
        f"{pose.views} pictures, corners {pose.error_px:.2f} px from where they should be; one "
        f"standard deviation is {pose.deviation_m * 1000:.1f} mm and "
        f"{np.degrees(pose.deviation_rad):.2f} degrees"
    )
    if not made.is_good and not made.refusal:
        _say("That is much. More pictures, tilted more, or a larger board make it less.")
