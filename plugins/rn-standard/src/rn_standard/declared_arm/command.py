"""The command `roboneuron config arm`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from roboneuron import ConfigurationError


class ConfigArm:
    """Say what the URDF of each declared arm gives, what was guessed on what grounds, and what it
    lacks.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron config arm`."""
        parser.add_argument("file", type=Path, help="the roboneuron.toml")

    def run(self, arguments: Namespace) -> int:
        """Print the report.

        Raises:
            ConfigurationError: the file declares no arm, or its description is refused.
        """
        from rn_standard.declared_arm.profile import draft_of  # numpy
        from roboneuron.command import load_config

        config = load_config(arguments.file)
        declared = [
            one.robot for one in config.robots.values() or (config,) if one.robot.arm is not None
        ]
        if not declared:
            raise ConfigurationError(
                f"{arguments.file} declares no arm.",
                hint='Write arm.urdf = "FILE" under [robot].',
            )
        for robot in declared:
            draft = draft_of(robot)
            print(*draft.report(), sep="\n")
            values = ", ".join(f"{value:g}" for value in draft.home.position.tolist())
            print(f"As `arm.home` of {robot.name!r} it is not searched for again: [{values}]")
        return 0
