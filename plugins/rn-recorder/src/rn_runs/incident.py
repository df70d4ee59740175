"""Incidents: what was in the ring around a fault, as one file of its own."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rn_runs.files import copy_records
from rn_runs.store import Store

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Incident:
    """An incident whose time after the fault has not passed yet."""

    id: str
    at_ns: int
    until_ns: int
    facts: list[dict[str, Any]] = field(default_factory=list)


def cut(incident: Incident, segments: list[Path], store: Store, ring_s: float, about: Mapping[str, str]) -> bool:
    """Write the file; returns whether that was possible.

    Args:
        segments: files of the ring, oldest first.
        ring_s: time before the fault that is kept [s].
        about: for the file's metadata.
    """
    names = ", ".join(str(fact["what"]) for fact in incident.facts)
    try:
        store.make()
        copy_records(
            segments,
            store.incidents / f"{incident.id}.mcap",
            {**about, "run": incident.id, "incident": names, "at_ns": str(incident.at_ns)},
            since_ns=incident.at_ns - round(ring_s * 1e9),
            until_ns=incident.until_ns,
            attachments={"incident.json": incident.facts},
        )
        (store.ring / f"{incident.id}.json").unlink(missing_ok=True)
    except OSError as error:
        log.error("The incident %s cannot be written: %s", incident.id, error)
        return False
    log.warning("Incident recorded: %s", incident.id)
    return True
