"""Refusals in the audit log of an episode's server: which rule of the gate it was."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

_SLACK_NS = 50_000_000


@dataclass(frozen=True, slots=True)
class Refusals:
    """Refusals of the gate, as (time [ns], tool, rule)."""

    entries: tuple[tuple[int, str, str], ...]

    def rule(self, tool: str, begun_ns: int, at_s: float, took_s: float) -> str:
        """The rule that refused a call of this tool; "" when none is known.

        Args:
            tool: its name.
            begun_ns: start of the episode [ns].
            at_s, took_s: when it was called, and for how long it ran [s].
        """
        from_ns = begun_ns + round(at_s * 1e9) - _SLACK_NS
        to_ns = from_ns + round(max(took_s, 0.0) * 1e9) + 2 * _SLACK_NS
        for time_ns, name, rule in self.entries:
            if name == tool and from_ns <= time_ns <= to_ns:
                return rule
        return ""


def read_refusals(state: Path, since_ns: int) -> Refusals:
    """Those of the audit logs in a state directory; lines that are no records are left out."""
    found: list[tuple[int, str, str]] = []
    for path in sorted(state.rglob("audit*.jsonl*")):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                entry = json.loads(line)
                time_ns = int(entry["time_ns"])
            except (ValueError, KeyError, TypeError):
                continue
            if entry.get("verdict") in ("refused", "would_refuse") and time_ns >= since_ns:
                found.append((time_ns, str(entry.get("tool")), str(entry.get("rule"))))
    return Refusals(tuple(found))
