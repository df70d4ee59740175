"""The command `roboneuron policy check`."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_standard.console.plugin_options import add_option, read_options
from roboneuron import ConfigurationError, InvalidInputError

if TYPE_CHECKING:
    from rn_recorder_policy.demonstration import Demonstration
    from rn_recorder_policy.report import CheckReport
    from rn_recorder_runs.deployed import DeployedBackend
    from roboneuron.feature import Config


class CheckPolicy:
    """Compare a policy's answers to recorded observations with the recorded actions, and report
    probable configuration errors.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron policy check`."""
        add = parser.add_argument
        add(
            "--dataset",
            type=Path,
            required=True,
            metavar="DIR",
            help="a LeRobot data set (v2.1 or v3), a recording's folder, or an MCAP file",
        )
        add("--episode", type=int, default=0, metavar="N", help="counted from 0 (default: 0)")
        add("--config", type=Path, metavar="FILE", help="a roboneuron.toml, as for serve")
        add("--backend", help="the policy (default: the configured one)")
        add("--checkpoint", help="folder of the model's files")
        add("--runtime", help="runtime; default: the configured one, or the backend's own")
        add("--acceleration", help="acceleration preset")
        add_option(parser, "the backend")
        add(
            "--map",
            action="append",
            default=[],
            metavar="NAME=CHANNEL",
            help="what a name of the data set is: a channel of the backend, a joint, or a "
            "coordinate (x_m, qx); NAME may be FEATURE:NAME; repeatable",
        )
        add(
            "--in-order",
            action="store_true",
            help="take actions and observation.state by their place (arm joints, then the "
            "gripper's opening), not by name",
        )
        add(
            "--camera",
            action="append",
            default=[],
            metavar="ROLE=NAME",
            help="which pictures of the data set the backend gets in a role; repeatable",
        )
        add("--action", default="action", metavar="FEATURE", help="holds the actions")
        add(
            "--unit",
            choices=("rad", "deg"),
            default="rad",
            help="of recorded angles (default: rad)",
        )
        add("--instruction", default="", help="in place of the recorded one")
        add("--frames", type=int, default=50, help="observations to ask for (default: 50)")
        add("--json", action="store_true", help="for programs")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron policy check`; status 1 if there is a probable error."""
        from rn_recorder_policy.report import show

        report = check_policy(arguments)
        if arguments.json:
            print(json.dumps(report.to_dict(), indent=1))
        else:
            show(report)
        return int(bool(report.diagnosis.faults))


def check_policy(arguments: Namespace) -> CheckReport:
    """Read the episode, load the backend, evaluate and compare.

    Raises:
        RoboNeuronError: something is missing, unknown, or does not fit.
    """
    from rn_recorder_policy.asking import LEAST_FRAMES, BackendQuery, ask
    from rn_recorder_policy.diagnosis import diagnose
    from rn_recorder_policy.name_mapping import NameMapping, parse_renamed
    from rn_recorder_policy.report import CheckReport
    from roboneuron.command import load_config

    if arguments.frames < LEAST_FRAMES:
        raise InvalidInputError(f"--frames is {arguments.frames}, expected >= {LEAST_FRAMES}.")
    mapping = NameMapping(
        renamed=parse_renamed(arguments.map),
        in_order=arguments.in_order,
        in_degrees=arguments.unit == "deg",
    )
    question = BackendQuery(
        mapping=mapping,
        feature=arguments.action,
        cameras=parse_renamed(arguments.camera),
        frames=arguments.frames,
        instruction=arguments.instruction,
    )
    demonstration = read_demonstration(arguments.dataset, arguments.episode)
    mapping.check(demonstration)
    settings = load_config(arguments.config)
    deployed = _build(settings, arguments)
    # names are compared before weights are loaded
    mapping.actions(demonstration, question.feature, deployed.agreement.executed)
    try:
        deployed.backend.load()
        asked = ask(deployed, demonstration, question)
    finally:
        deployed.backend.close()
    return CheckReport(
        source=demonstration.source,
        backend=deployed.spec.name,
        robot=deployed.profile.name,
        asked=asked,
        diagnosis=diagnose(asked.answers),
    )


def read_demonstration(path: Path, episode: int) -> Demonstration:
    """Read an episode of the data set or recording at that path.

    Raises:
        InvalidInputError: it is neither a data set nor a recording, or as their readers.
        MissingDependencyError: the package that reads it is not installed.
    """
    from rn_recorder_policy.lerobot_reading import INFO, read_lerobot
    from rn_recorder_policy.run_reading import read_run

    if (path / INFO).is_file():
        return read_lerobot(path, episode)
    files = [path] if path.suffix == ".mcap" and path.is_file() else sorted(path.glob("*.mcap"))
    if not files:
        raise InvalidInputError(
            f"{path} is neither a LeRobot data set (it has no {INFO}) nor a recording (no MCAP "
            "files).",
            hint="Name the folder that holds `meta`, or a folder of `roboneuron runs list`.",
        )
    return read_run(files, episode)


def _build(settings: Config, arguments: Namespace) -> DeployedBackend:
    """Build the backend named in the arguments, otherwise the configured one.

    Raises:
        ConfigurationError: none is named, or it belongs to another interpreter.
        RoboNeuronError: as `build_backend`.
    """
    from rn_recorder_runs.deployed import build_backend

    section = settings.inference
    name = arguments.backend or (section.backend if section is not None else None)
    if name is None:
        raise ConfigurationError(
            "No backend is configured.", hint="Give --config FILE or --backend NAME."
        )
    checkpoint, runtime, acceleration = (
        arguments.checkpoint,
        arguments.runtime,
        arguments.acceleration,
    )
    if section is not None and section.backend == name:
        if section.python is not None and Path(section.python) != Path(sys.executable):
            raise ConfigurationError(
                f"The backend runs under {section.python}, this command under {sys.executable}.",
                hint=f"Run {Path(section.python).with_name('roboneuron')} policy check.",
            )
        checkpoint = checkpoint or section.checkpoint
        runtime = runtime or section.runtime
        acceleration = acceleration or section.acceleration
    return build_backend(
        settings,
        backend=name,
        robot=settings.robot.name,
        driver=settings.robot.driver,
        checkpoint=checkpoint,
        runtime=runtime,
        acceleration=acceleration,
        options=read_options(arguments.option, name),
    )
