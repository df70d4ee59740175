"""Rules of commands: quick to import, with a help text."""

from __future__ import annotations

import subprocess
import sys
from argparse import ArgumentParser

from rn_testing.attempts import attempt
from rn_testing.cases import CommandCase
from rn_testing.effects import HEAVY_MODULES, find_effects
from rn_testing.lifecycle import PURE, check_pure_constructor
from rn_testing.process_state import find_changes
from rn_testing.rule import Rule, require

_HEAVY = (*HEAVY_MODULES, "rclpy", "mcp")


def _check_protocol(case: CommandCase) -> None:
    made = attempt(case, case.build)
    for name in ("configure", "run"):
        require(callable(getattr(made, name, None)), f"it has no method `{name}`")


def _check_help(case: CommandCase) -> None:
    made = attempt(case, case.build)
    require(bool((made.__doc__ or "").strip()), "its class has no docstring, which `--help` shows")
    parser = ArgumentParser(prog=f"roboneuron {case.spec.name}", description=made.__doc__)
    made.configure(parser)
    parser.format_help()
    bare = [a.dest for a in parser._actions if not a.help]
    require(not bare, f"it has arguments without help: {', '.join(bare)}")


def _check_configure(case: CommandCase) -> None:
    made = attempt(case, case.build)
    parser = ArgumentParser(prog=f"roboneuron {case.spec.name}")
    _, effects = find_effects(lambda: made.configure(parser))
    require(not effects, f"configure {'; '.join(effects)}; that belongs into `run`")
    changes = find_changes(lambda: made.configure(ArgumentParser(prog="roboneuron")))
    require(not changes, f"configure {'; '.join(changes)}")


def _check_light(case: CommandCase) -> None:
    module = case.spec.target.partition(":")[0]
    script = f"import sys, {module}; print(*[m for m in {_HEAVY!r} if m in sys.modules])"
    # so that no file in the working directory shadows a module
    command = [sys.executable, "-P", "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    require(done.returncode == 0, f"importing {module} fails: {done.stderr.strip()[-300:]}")
    require(
        not done.stdout.strip(),
        f"importing {module} imports {done.stdout.strip()}; do that in `run`",
    )


_SOURCE = "roboneuron.cli.listing.CommandModule"

RULES: tuple[Rule[CommandCase], ...] = (
    Rule(
        id="command/protocol",
        text="It has `configure` and `run`.",
        source=_SOURCE,
        check=_check_protocol,
    ),
    Rule(id="command/constructor-pure", text=PURE, source=_SOURCE, check=check_pure_constructor),
    Rule(
        id="command/configure-pure",
        text="`configure` declares arguments and does nothing else: it runs for `--help` too.",
        source=_SOURCE,
        check=_check_configure,
    ),
    Rule(
        id="command/help",
        text="Class and arguments say what they do.",
        source=_SOURCE,
        check=_check_help,
    ),
    Rule(
        id="command/light",
        text="Importing it imports nothing heavy: `--help` answers at once.",
        source=_SOURCE,
        check=_check_light,
    ),
)
"""Rules of commands."""
