"""The command `roboneuron logs`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from roboneuron.command import state_folder

_MODULES = ("robot", "perception", "inference", "control", "server")


class _Suggested(tuple[str, ...]):
    """Words for the completion of a shell; others are accepted too."""

    def __contains__(self, word: object) -> bool:
        return True


class Logs:
    """Show the logs of a server's newest run: those of its modules and its own, in order of time.

    They are files below the state directory; no server is needed.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron logs`."""
        parser.add_argument(
            "module",
            metavar="MODULE",
            nargs="?",
            choices=_Suggested(_MODULES),
            help=f"{', '.join(_MODULES)}, or one that a plugin adds",
        )
        parser.add_argument(
            "-f", "--follow", action="store_true", help="go on with what is added, until Ctrl-C"
        )
        parser.add_argument(
            "-n",
            "--lines",
            type=int,
            default=50,
            metavar="N",
            help="the newest N lines (50); 0: all",
        )
        parser.add_argument("--runs", action="store_true", help="list the runs instead")
        parser.add_argument(
            "--run", metavar="NAME", help="a run of that list instead of the newest"
        )
        state_folder.add_arguments(parser, with_robot=False)

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron logs`."""
        from rn_standard.console.log_reading import LogView, choose_run
        from rn_standard.console.log_runs import log_runs
        from rn_standard.console.table import make_console

        directory = state_folder.folders_of(arguments)[0]
        if arguments.runs:
            for run in log_runs(directory):
                print(f"{run.path.name}  {', '.join(run.files()) or 'empty'}")
            return 0
        view = LogView(choose_run(directory, arguments.run), arguments.module, make_console())
        view.show_last(arguments.lines)
        if arguments.follow:
            try:
                view.follow(None if arguments.run else directory)
            except KeyboardInterrupt:  # how following ends
                return 0
        return 0
