"""Replacement of the backend while the arm moves: warm compared with cold, in one run.

    python benchmarks/bench_switch.py [--switches 50] [--cold 5] [--rates 10 30] [--rows 16
    --delay-ms 100]

The camera numbers its images and the actions return the number, so that a missed period is an image
without an action, and a late one shows in the send times of actions (DDS source times). "Elsewhere"
is the same stream between switches: the effect of the machine itself. The velocity step is the
change of the commanded velocity of the moving joint from one command to the next. With --rows the
backends answer with chunks, executed in the mode `auto`; each row belongs to a period of the
camera, and periods without a row count as missed.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from plugin_site import chunks
from rich.console import Console
from rich.table import Table
from switch_loop import Sent, moving_loop

from roboneuron.errors import RoboNeuronError
from roboneuron.selection.requests import StartChosenInference
from roboneuron.switching.replacing import Switching, SwitchMode


@dataclass(frozen=True, kw_only=True, slots=True)
class Outcome:
    """Results of one series of switches.

    Attributes:
        gaps_s: time from the last action of the old to the first action of the new backend.
        missed: images, or periods of a chunk, without an action at the switches.
        elsewhere_s: times between the other actions.
        skipped: the same between the switches, of `images`.
        twice: rows of a chunk that were sent twice.
        step_m_s, step_elsewhere_m_s: largest change of the commanded velocity.
        took_s: median duration of the call.
    """

    gaps_s: np.ndarray
    missed: int
    elsewhere_s: np.ndarray
    skipped: int
    images: int
    twice: int
    step_m_s: float
    step_elsewhere_m_s: float
    took_s: float


def judge(
    actions: list[Sent], commands: list[tuple[int, float, float]], took_s: list[float]
) -> Outcome:
    """Compare the stream at the switches with the rest of it."""
    pairs = list(itertools.pairwise(actions))
    changes = [(a, b) for a, b in pairs if a.tag != b.tag]
    rest = [(a, b) for a, b in pairs if a.tag == b.tag]
    at, target = np.array([c[0] for c in commands]) / 1e9, np.array([c[1] for c in commands])
    velocity = np.diff(target) / np.maximum(np.diff(at), 1e-3)
    steps, step_at = np.abs(np.diff(velocity)), at[2:]
    near = np.zeros(len(steps), dtype=bool)
    for a, b in changes:
        near |= (step_at > a.at_ns / 1e9 - 0.05) & (step_at < b.at_ns / 1e9 + 0.25)
    return Outcome(
        gaps_s=np.array([(b.at_ns - a.at_ns) / 1e9 for a, b in changes]),
        missed=sum(max(0, b.slot - a.slot - 1) for a, b in changes),
        elsewhere_s=np.array([(b.at_ns - a.at_ns) / 1e9 for a, b in rest]),
        skipped=sum(max(0, b.slot - a.slot - 1) for a, b in rest),
        images=actions[-1].slot - actions[0].slot + 1,
        twice=len(actions) - len({(action.image, action.row) for action in actions}),
        step_m_s=float(steps[near].max(initial=0.0)),
        step_elsewhere_m_s=float(steps[~near].max(initial=0.0)),
        took_s=float(np.median(took_s)),
    )


def _await_stream(switching: Switching, witness: object) -> None:
    """Wait for some actions of the current backend: its own stream, and the end of the last gap."""
    plan = switching.loop.modules.view("inference").plan
    tag = 2 if plan is not None and plan.names["backend"] == "second" else 1
    deadline_s = time.monotonic() + 5.0
    while time.monotonic() < deadline_s:
        if all(action.tag == tag for action in witness.actions()[-5:]):  # type: ignore[attr-defined]
            return
        threading.Event().wait(0.05)


def series(
    switching: Switching, witness: object, mode: SwitchMode, count: int, console: Console
) -> Outcome:
    """Switch `count` times and evaluate the stream meanwhile."""
    first_action = max(0, len(witness.actions()) - 1)  # type: ignore[attr-defined]
    first_command = len(witness.commands())  # type: ignore[attr-defined]
    took_s = []
    for number in range(count):
        view = switching.loop.modules.view("inference")
        assert view.plan is not None
        other = "second" if view.plan.names["backend"] == "first" else "first"
        try:
            arguments = StartChosenInference(backend=other, options={})
            took_s.append(switching.switch("inference", arguments, mode).took_s)
        except RoboNeuronError as error:  # nothing changed, which is counted
            console.log(f"{mode} {number + 1}/{count} refused: {error.message}")
            continue
        console.log(f"{mode} {number + 1}/{count}: {took_s[-1]:.1f} s")
    _await_stream(switching, witness)
    actions = witness.actions()[first_action:]  # type: ignore[attr-defined]
    return judge(actions, witness.commands()[first_command:], took_s)  # type: ignore[attr-defined]


def main() -> None:
    """Run everything and print one table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--switches", type=int, default=50, metavar="N", help="warm switches at each rate"
    )
    parser.add_argument(
        "--cold", type=int, default=5, metavar="N", help="cold switches at each rate"
    )
    parser.add_argument(
        "--rates",
        type=float,
        nargs="+",
        default=[10.0, 30.0],
        metavar="HZ",
        help="images per second",
    )
    parser.add_argument(
        "--rows", type=int, default=1, metavar="N", help="actions of a chunk, one each period"
    )
    parser.add_argument(
        "--delay-ms", type=float, default=0.0, metavar="MS", help="time that a prediction takes"
    )
    arguments = parser.parse_args()
    console = Console(width=150)
    progress = Console(stderr=True)
    table = Table(title="Change of the backend during motion")
    heads = (
        "rate, mode|switches|images missed|acted on twice|gap min/p50/p99/max [ms]|elsewhere "
        "p50/p99/max [ms]"
    )
    for head in (
        *heads.split("|"),
        "skipped elsewhere",
        "velocity step / elsewhere [m/s]",
        "call [s]",
    ):
        table.add_column(head)
    for rate_hz in arguments.rates:
        options = chunks(arguments.rows, arguments.delay_ms, rate_hz)
        with (
            tempfile.TemporaryDirectory() as scratch,
            moving_loop(Path(scratch), rate_hz, backend_options=options) as (switching, witness),
        ):
            for mode, count in (("warm", arguments.switches), ("cold", arguments.cold)):
                if not count:
                    continue
                outcome = series(switching, witness, mode, count, progress)  # type: ignore[arg-type]

                def spread(values_s: np.ndarray, *shares: int) -> str:
                    if not len(values_s):
                        return "-"
                    return " / ".join(
                        f"{value:.0f}" for value in np.percentile(values_s, shares) * 1e3
                    )

                report = switching.loop.modules.view("inference").report
                mode_now = "" if report is None else report.metrics.get("execution.mode", "")
                executed = "" if arguments.rows == 1 else f", {mode_now} of {arguments.rows} rows"
                row = [
                    f"{rate_hz:g} Hz, {mode}{executed}",
                    f"{len(outcome.gaps_s)} of {count}",
                    str(outcome.missed),
                    str(outcome.twice),
                    spread(outcome.gaps_s, 0, 50, 99, 100),
                    spread(outcome.elsewhere_s, 50, 99, 100),
                    f"{outcome.skipped} of {outcome.images}",
                    f"{outcome.step_m_s:.3f} / {outcome.step_elsewhere_m_s:.3f}",
                    f"{outcome.took_s:.1f}",
                ]
                table.add_row(*row)
                progress.log(" | ".join(row))
    console.print(table)


if __name__ == "__main__":
    main()
