"""The command `roboneuron demo`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

DEFAULT_INSTRUCTION = "pick up the red cube"


class Demo:
    """An agent stand-in picks up an object with the simulated robot, over MCP only; status 0 means it was lifted."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron demo`."""
        parser.add_argument("--instruction", default=DEFAULT_INSTRUCTION, help=f"default: {DEFAULT_INSTRUCTION!r}")
        parser.add_argument("--seed", type=int, help="scene to play in; default: a new one, or that of --config")
        parser.add_argument("--gui", action="store_true", help="show the simulator's window (needs a display)")
        parser.add_argument("--timeout-s", type=float, default=90.0, help="give up after this long (default 90)")
        parser.add_argument("--output", type=Path, default=Path("out/demo"), help="where film and log go")
        parser.add_argument(
            "--config", type=Path, default=None, help="a roboneuron.toml; the embedded default without it"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron demo`."""
        import random

        import anyio
        from rich.console import Console

        from rn_demo.run import DemoOptions, run_demo

        seed = arguments.seed
        if seed is None and arguments.config is None:
            seed = random.SystemRandom().randrange(10_000)
        options = DemoOptions(
            instruction=arguments.instruction,
            seed=seed,
            gui=arguments.gui,
            timeout_s=arguments.timeout_s,
            output=arguments.output,
            config=arguments.config,
        )
        return 0 if anyio.run(run_demo, options, Console(highlight=False)) else 1
