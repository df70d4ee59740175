"""`roboneuron plugins rules [KIND]`: prints the contract rules."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from roboneuron import ConfigurationError
from roboneuron.command import PLUGIN_KINDS


class PluginsRules:
    """Print the contract rules that `roboneuron plugins check` runs for a kind of plugin."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the argument of `roboneuron plugins rules`."""
        parser.add_argument(
            "kind",
            metavar="KIND",
            nargs="?",
            help="only the rules of this kind, or those of packages; default: all",
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron plugins rules`.

        Raises:
            ConfigurationError: there is no such kind.
        """
        from rich.console import Console
        from rich.table import Table

        from rn_testing.rules import rules_of

        kinds = ["package", *sorted(PLUGIN_KINDS)]
        if arguments.kind is not None and arguments.kind not in kinds:
            raise ConfigurationError(
                f"There is no kind {arguments.kind!r}.", hint=f"Kinds: {', '.join(kinds)}."
            )
        wanted = kinds if arguments.kind is None else [arguments.kind]
        rules = {rule.id: rule.text for kind in wanted for rule in rules_of(kind)}
        table = Table(box=None, pad_edge=False, header_style="bold")
        table.add_column("RULE", no_wrap=True)
        table.add_column("WHAT MUST HOLD", overflow="fold")
        for name, text in rules.items():
            table.add_row(name, text)
        Console(highlight=False, markup=False, emoji=False).print(table)
        return 0
