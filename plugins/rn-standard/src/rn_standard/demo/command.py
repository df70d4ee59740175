"""The command `roboneuron demo`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from roboneuron import ConfigurationError, install_command

DEFAULT_INSTRUCTION = "pick up the red cube"
POLICIES = ("servo", "learned")


class Demo:
    """An agent stand-in picks up an object with the simulated robot, over MCP only; status 0 means
    it was lifted, 75 that this machine was too slow for real time.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron demo`."""
        parser.add_argument(
            "--instruction", default=DEFAULT_INSTRUCTION, help=f"default: {DEFAULT_INSTRUCTION!r}"
        )
        parser.add_argument(
            "--policy",
            choices=POLICIES,
            help="servo: classical visual servoing, the default; learned: the small network of "
            "rn-policy-cubes",
        )
        parser.add_argument(
            "--seed", type=int, help="scene to play in; default: a new one, or that of --config"
        )
        parser.add_argument(
            "--gui", action="store_true", help="show the simulator's window (needs a display)"
        )
        parser.add_argument(
            "--max-s", type=float, default=90.0, help="give up after this long (default 90)"
        )
        parser.add_argument(
            "--out", type=Path, default=Path("out/demo"), help="where film and log go"
        )
        parser.add_argument(
            "--config",
            type=Path,
            default=None,
            help="a roboneuron.toml; the embedded default without it",
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron demo`."""
        import random

        from rich.console import Console

        from rn_standard.demo.pace import run_paced
        from rn_standard.demo.run import DemoOptions, run_demo

        seed = arguments.seed
        if seed is None and arguments.config is None:
            seed = random.SystemRandom().randrange(10_000)
        options = DemoOptions(
            instruction=arguments.instruction,
            seed=seed,
            gui=arguments.gui,
            max_s=arguments.max_s,
            output=arguments.out,
            config=_configuration(arguments),
        )
        return run_paced(lambda pace: run_demo(options, Console(highlight=False), pace))


def _configuration(arguments: Namespace) -> Path | None:
    """The given configuration file, or that of the learned policy."""
    if arguments.policy is None:
        return arguments.config  # type: ignore[no-any-return]
    if arguments.config is not None:
        raise ConfigurationError("--policy and --config both choose the policy: leave one out.")
    if arguments.policy == "servo":
        return None
    try:
        from rn_policy_cubes.checkpoint import shipped_configuration
    except ImportError as error:
        raise ConfigurationError(
            "The learned policy is not installed.",
            hint=f"Run: {install_command('rn-policy-cubes')}.",
        ) from error
    return shipped_configuration(arguments.out)
