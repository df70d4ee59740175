"""The command `roboneuron completion`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

SHELLS = ("bash", "zsh", "fish")


class Completion:
    """Print a script that completes the commands and options of `roboneuron` in a shell.

    bash: roboneuron completion bash > ~/.local/share/bash-completion/completions/roboneuron --
    zsh: roboneuron completion zsh > ~/.zfunc/_roboneuron (a folder in fpath) -- fish: roboneuron
    completion fish > ~/.config/fish/completions/roboneuron.fish. Commands of installed plugins
    are in it: print it again after installing or removing one. No Python is started while
    completing.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron completion`."""
        parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron completion`."""
        import shtab

        from rn_standard.console.parsers import whole_parser

        print(shtab.complete(whole_parser(), shell=arguments.shell))
        return 0
