"""The command `roboneuron run`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace


class RunCommand:
    """Start what the configuration names, carry out one instruction as the tool run_task does,
    report its outcome, and stop everything again.

    Exit status: 0 succeeded; 1 failed, timed out or stopped; 2 it could not be started; 3 unclear:
    nothing tells whether it is done; 130 interrupted.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron run`."""
        from rn_standard.console import connection

        parser.add_argument(
            "instruction", metavar="INSTRUCTION", help='what to do, such as "pick up the red cube"'
        )
        connection.add_arguments(parser)
        parser.add_argument(
            "--until",
            metavar="WORDS",
            help='success condition: "held", "lifted" or "on COLOUR"; without it, the verbs that '
            "the policy declares are judged by themselves",
        )
        parser.add_argument(
            "--max-s", type=float, metavar="SECONDS", help="longest time of one attempt"
        )
        parser.add_argument("--max-attempts", type=int, metavar="NUMBER", help="most attempts")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron run`."""
        from roboneuron import ConfigurationError
        from roboneuron.command import load_config

        if not arguments.instruction.strip():
            raise ConfigurationError(
                "The instruction is empty.", hint='Say what to do: "pick up the red cube".'
            )
        where = f"with the server at {arguments.url}"
        if arguments.url is None:
            # its errors are reported here, before a server is started
            config = load_config(arguments.config)
            where = f"with {config.robot.name} ({config.robot.driver})"
        import anyio  # heavy

        from rn_standard.console.screen import CommandScreen
        from rn_standard.console.story import run_instruction
        from rn_standard.console.table import make_console

        screen = CommandScreen(make_console(), is_quiet=bool(arguments.quiet))
        screen.title(f'"{arguments.instruction}" {where}')
        return anyio.run(run_instruction, arguments, screen)
