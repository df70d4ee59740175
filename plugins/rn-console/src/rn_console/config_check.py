"""The command `roboneuron config check`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path


class ConfigCheck:
    """Say what is wrong with a roboneuron.toml, as `roboneuron serve` would at its start."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron config check`."""
        parser.add_argument("file", type=Path, help="the roboneuron.toml")

    def run(self, arguments: Namespace) -> int:
        """Refuse what `roboneuron serve` would refuse at its start, but for the address it listens on."""
        from roboneuron.config import load_config
        from roboneuron.plugins.discovery import discover
        from roboneuron.server.app import Application  # heavy
        from roboneuron.server.sections import check_configuration

        config = load_config(arguments.file)
        check_configuration(config, discover(config.disabled_plugins))
        application = Application(config)  # derives the tools of [[expose]]
        try:
            application.features.check()
        finally:
            application.close()
        print(f"{arguments.file} is valid: robot {config.robot.name!r}, namespace /{config.namespace}.")
        return 0
