"""Incidents: the ring's content around a fault, in a separate file."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rn_recorder_runs.files import copy_records
from rn_recorder_runs.store import RunStore
from roboneuron import foreign

log = logging.getLogger(__name__)
LATE_NS = 5_000_000_000
"""Maximum delay before a message is written: it is then in the ring behind the part that the
incident already has.
"""


@dataclass(slots=True)
class OpenIncident:
    """An incident whose time after the fault is not over yet."""

    id: str
    at_ns: int
    until_ns: int
    facts: list[dict[str, object]] = field(default_factory=list)
    kept_ns: int = 0
    """Time up to which its file is complete; 0 before there is one."""

    def begin_ns(self, ring_s: float) -> int:
        """Start of the required part of the ring."""
        return self.kept_ns - LATE_NS if self.kept_ns else self.at_ns - round(ring_s * 1e9)

    def due_ns(self, ring_s: float, after_s: float) -> int:
        """Time at which it has to be written: soon the first time, afterwards only after a quiet
        period.
        """
        if not self.kept_ns:
            return self.at_ns + round(after_s * 1e9)
        return self.until_ns + round(ring_s * 1e9)


def cut(
    incident: OpenIncident,
    segments: list[Path],
    store: RunStore,
    ring_s: float,
    about: Mapping[str, str],
) -> bool:
    """Write the file, or append newer messages to it; return True on success.

    Args:
        segments: files of the ring, oldest first.
        ring_s: time before the fault that is kept [s].
        about: for the file's metadata.
    """
    names = ", ".join(str(fact["what"]) for fact in incident.facts)
    try:
        store.make()
        target = store.incidents / f"{incident.id}.mcap"
        earlier = [target] if incident.kept_ns and target.exists() else []
        copy_records(
            [*earlier, *segments],
            target,
            {**about, "run": incident.id, "incident": names, "at_ns": str(incident.at_ns)},
            since_ns=incident.at_ns - round(ring_s * 1e9),
            again_ns=incident.kept_ns - LATE_NS if earlier else None,
            until_ns=incident.until_ns,
            attachments={"incident.json": incident.facts},
        )
        (store.ring / f"{incident.id}.json").unlink(missing_ok=True)
    except OSError as error:
        log.error("The incident %s cannot be written: %s", incident.id, error)
        return False
    log.warning("Incident recorded: %s", incident.id)
    return True


def to_incident(told: object) -> OpenIncident:
    """An incident that an earlier recorder did not finish. Raises ForeignDataError."""
    facts = foreign.items(foreign.field(told, "facts"), "facts", most=10_000)
    return OpenIncident(
        id=foreign.text(foreign.field(told, "id"), "id"),
        at_ns=foreign.integer(foreign.field(told, "at_ns"), "at_ns"),
        until_ns=foreign.integer(foreign.field(told, "until_ns"), "until_ns"),
        facts=[foreign.table(one, "a fact") for one in facts],
        kept_ns=foreign.integer(foreign.table(told, "an incident").get("kept_ns", 0), "kept_ns"),
    )
