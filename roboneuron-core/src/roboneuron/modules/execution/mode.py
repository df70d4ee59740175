"""Choice of the execution mode by the measured latency and the backend's abilities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from roboneuron.errors import ConfigurationError
from roboneuron.modules.execution.latency import LatencyWindow, rows_in
from roboneuron.plugins.specs import BackendSpec

__all__ = ["Mode"]
"""Names that other distributions may use."""

Mode = Literal["sequential", "overlap", "rtc", "predicted-state"]
"""Execution mode of chunks.

- `sequential`: predict, play the chunk, predict again.
- `overlap`: predict while the last chunk plays; stale rows are skipped, the seam is cross-faded.
- `rtc` (real-time chunking): as overlap, and the backend continues the rows still to be played.
- `predicted-state`: the backend gets the state rolled forward to the end of the running chunk;
  chunks follow whole.
"""
MODES: tuple[Mode, ...] = ("sequential", "overlap", "rtc", "predicted-state")
_AGREEING = 10
"""Number of consecutive answers that must agree on another mode before it changes, against
oscillation.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Abilities:
    """Abilities declared in a backend's descriptor (see `BackendSpec`).

    Attributes:
        conditions_on_rows: continues `Ahead.rows` (real-time chunking).
        max_committed_rows: rows it can keep at most; 0 for any number.
        takes_predicted_state: trained on states ahead of the image.
    """

    conditions_on_rows: bool = False
    max_committed_rows: int = 0
    takes_predicted_state: bool = False


def abilities_of(backend: BackendSpec) -> Abilities:
    """Return the abilities declared in a backend's descriptor."""
    return Abilities(
        conditions_on_rows=backend.conditions_on_rows,
        max_committed_rows=backend.max_committed_rows,
        takes_predicted_state=backend.takes_predicted_state,
    )


@dataclass(frozen=True, slots=True)
class ModeChoice:
    """A mode and the numbers behind the choice.

    Attributes:
        mode: the mode.
        reason: one sentence for the status.
    """

    mode: Mode
    reason: str


def choose(horizon: int, typical_rows: int, worst_rows: int, abilities: Abilities) -> ModeChoice:
    """Return the suitable mode.

    Args:
        horizon: rows of a chunk.
        typical_rows, worst_rows: rows played during one inference, by the median and by the 99th
            percentile.
        abilities: abilities of the backend.

    During an inference d rows are played, and its answer adds H - d new ones. So overlap keeps the
    arm moving as long as 2 d + 1 <= H, where 1 is the row that is due when the answer arrives. For
    larger d it pauses, but less than sequential execution, as long as the typical answer adds any
    row in time.
    """
    d, h = worst_rows, horizon
    overlapped: Mode = "rtc" if _can_condition(abilities, d) else "overlap"
    if h == 1:  # its answer would be stale as soon as the previous row is sent
        return ModeChoice("sequential", "chunks of one row have nothing to overlap")
    if 2 * d + 1 <= h:
        return ModeChoice(overlapped, f"2 x {d} + 1 rows of latency fit into chunks of {h}")
    if typical_rows > h:
        return ModeChoice(
            "sequential", f"{typical_rows} rows of latency, chunks of {h}: no row would be in time"
        )
    # a late answer starves the arm, but still continues at the end of the rows
    if abilities.takes_predicted_state:
        return ModeChoice(
            "predicted-state", f"{d} rows of latency: whole chunks of {h}, the state rolled forward"
        )
    return ModeChoice(
        overlapped,
        f"{d} rows of latency are much for chunks of {h}: the arm pauses; use longer chunks",
    )


def _can_condition(abilities: Abilities, delay_rows: int) -> bool:
    most = abilities.max_committed_rows
    return abilities.conditions_on_rows and (most == 0 or delay_rows <= most)


def check_mode(mode: Mode, abilities: Abilities, backend: str) -> None:
    """Raise ConfigurationError if a backend does not support a mode that the configuration
    fixes.
    """
    lacks = (mode == "rtc" and not abilities.conditions_on_rows) or (
        mode == "predicted-state" and not abilities.takes_predicted_state
    )
    if lacks:
        raise ConfigurationError(
            f"inference.execution is {mode!r}, which backend {backend!r} cannot do.",
            hint="Use 'auto', which chooses what it can.",
        )


class ModeSelector:
    """Mode in force: a fixed one, or the chosen one after ten answers that agree on it.

    Until a typical latency is known each answer decides at once, so that a fast backend does not
    play ten chunks sequentially.
    """

    def __init__(self, fixed: Mode | None, abilities: Abilities) -> None:
        self.abilities = abilities
        self._fixed = fixed
        self.current = ModeChoice(
            fixed or "sequential",
            "fixed by inference.execution" if fixed else "no latency is known",
        )
        self._wanted = self.current.mode
        self._agreeing = 0
        self._is_decided = False

    def update(self, horizon: int, step_s: float, latency: LatencyWindow) -> ModeChoice:
        """Add one more answer; return the choice in force.

        Args:
            horizon, step_s: of its chunk.
            latency: latencies, that of this answer included.
        """
        p50_s, p99_s = latency.p50_s, latency.p99_s
        if self._fixed or p50_s is None or p99_s is None:
            return self.current
        wanted = choose(horizon, rows_in(p50_s, step_s), rows_in(p99_s, step_s), self.abilities)
        self._agreeing = self._agreeing + 1 if wanted.mode == self._wanted else 1
        self._wanted = wanted.mode
        if wanted.mode == self.current.mode or not self._is_decided or self._agreeing >= _AGREEING:
            self.current = wanted
        self._is_decided = self._is_decided or latency.is_known
        return self.current
