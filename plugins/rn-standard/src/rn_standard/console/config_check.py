"""The command `roboneuron config check`."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path


class ConfigCheck:
    """Report errors in a roboneuron.toml, as `roboneuron serve` would at its start."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron config check`."""
        parser.add_argument("file", type=Path, help="the roboneuron.toml")

    def run(self, arguments: Namespace) -> int:
        """Refuse what `roboneuron serve` would refuse at its start, except ports in use, which a
        running server may hold; and name what it would leave out, which gives 1.
        """
        from roboneuron.command import (
            check_configuration,
            discover,
            load_config,
            make_served,  # heavy
        )
        from roboneuron.modules.arm_paths import UncheckedPaths  # numpy

        config = load_config(arguments.file)
        if not config.robots:
            check_configuration(config, discover(config.disabled_plugins, config.robot))
        served = make_served(config)  # derives the tools of [[expose]]
        try:
            served.check()
            omitted = served.omitted
        finally:
            served.close()
        for one in config.robots.values() or (config,):
            registry = discover(one.disabled_plugins, one.robot)
            if told := UncheckedPaths().why(one, registry):
                print(f"Note: {told}")
        for reason in omitted:
            print(f"Left out: {reason}", file=sys.stderr)
        if omitted:
            return 1
        if config.robots:
            named = ", ".join(
                f"{name} ({one.robot.name}, /{one.namespace})"
                for name, one in config.robots.items()
            )
            print(f"{arguments.file} is valid: robots {named}.")
            return 0
        print(
            f"{arguments.file} is valid: robot {config.robot.name!r}, namespace "
            f"/{config.namespace}."
        )
        return 0
