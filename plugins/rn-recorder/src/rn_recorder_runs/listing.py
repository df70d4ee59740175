"""Output of `roboneuron runs list` and `runs show`."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rn_recorder_runs.files import is_finished, read_about
from rn_recorder_runs.reading import count_topics, iterate
from rn_recorder_runs.repairing import read_origin
from rn_recorder_runs.store import Run, RunStore, decoded_event
from roboneuron import foreign

_MOST_OF_ROW = 1000


def list_runs(store: RunStore, as_json: bool) -> int:
    """Print every run of a directory, oldest first; repairs truncated ones."""
    for path in store.repair():
        print(f"Repaired: {path}", file=sys.stderr)
    rows: list[dict[str, Any]] = []
    for run in store.runs():
        first_ns, last_ns, messages = run.span()
        rows.append(
            {
                "id": run.id,
                "kind": run.kind,
                "begun_at": _time(first_ns or int(run.facts.get("begun_ns") or 0)),
                "duration_s": round((last_ns - first_ns) / 1e9, 1),
                "messages": messages,
                "size_bytes": run.size_bytes,
                "files": [str(path) for path in run.files],
                "state": str(run.facts.get("state", "finished")),
                "outcome": run.told["outcome"],
                "note": run.told["comment"],
                "complete": run.is_complete,
            }
        )
    if as_json:
        print(json.dumps(rows, indent=1))
        return 0
    for row in rows:
        told = " ".join(str(row[key]) for key in ("state", "outcome", "note") if row[key])
        what = foreign.printable(told)
        size = f"{row['size_bytes'] / 1e6:.1f} MB"
        print(
            f"{row['id']:<52} {row['kind']:<9} {row['duration_s']:>7.1f} s {size:>11} "
            f"{row['messages']:>8}  {what}"
        )
    if not rows:
        print(f"There are no runs in {store.directory}.")
    return 0


def show_run(run: Run, as_json: bool) -> int:
    """Print the content of a run; status 1 if one of its files cannot be read to its end."""
    damage: dict[Path, list[str]] = {}
    topics = count_topics(run.files, damage)
    about = read_about(run.files[0]) if run.files else {}
    events = _events(run.files) if about else []  # of this program
    faults = [fault for path in run.files if (fault := _fault(path, damage[path], about))]
    for fault in faults:
        print(fault, file=sys.stderr)
    if faults and not topics:
        return 1
    if as_json:
        rows = {
            topic: {name: getattr(counts, name) for name in counts.__dataclass_fields__}
            for topic, counts in topics.items()
        }
        print(
            json.dumps(
                {
                    "id": run.id,
                    "about": about,
                    "facts": run.facts,
                    "topics": rows,
                    "events": events,
                },
                indent=1,
            )
        )
        return int(bool(faults))
    origin = read_origin(run.files[0]) if run.files else ""
    if about:
        said = f"robot {about.get('robot', '?')}, images {about.get('images', '?')}"
    else:
        said = f"of another program: {origin or 'no MCAP file'}"
    print(f"{run.id} ({run.kind}), {foreign.printable(said)}")
    for path in run.files:
        print(f"  {path}")
    print(f"\n{'topic':<46} {'type':<34} {'count':>7} {'rate':>8} {'lost':>5}")
    for topic, counts in topics.items():
        span_s = (counts.last_ns - counts.first_ns) / 1e9
        rate = f"{(counts.messages - 1) / span_s:.1f} Hz" if span_s > 0 else ""
        lost = "?" if counts.lost is None else str(counts.lost)
        shown = f"{topic:<46} {counts.type:<34} {counts.messages:>7} {rate:>8} {lost:>5}"
        print(foreign.printable(f"{shown}  {counts.note}".rstrip(), _MOST_OF_ROW))
    print()
    for event in events:
        facts = {
            k: v for k, v in event.items() if k not in ("topic", "at_ns", "time", "time_ns") and v
        }
        print(f"{_time(event['at_ns'])} {json.dumps(facts)[:160]}")
    return int(bool(faults))


def _events(files: Sequence[Path]) -> list[dict[str, Any]]:
    found = iterate(files, lambda topic: topic.startswith("/roboneuron/"))
    return [
        {
            "topic": one.record.topic,
            "at_ns": one.record.publish_ns,
            **decoded_event(one.message.data),
        }
        for one in found
    ]


def _fault(path: Path, damage: Sequence[str], about: Mapping[str, str]) -> str:
    """What is wrong with a file, and what to do; empty for a whole one. One of this program without
    an end is being written, or is repaired by `runs list`.
    """
    if not read_origin(path):
        return (
            f"{path} is no MCAP file{': ' + damage[0] if damage else ''}. Name a file of "
            "`ros2 bag record -s mcap`, or a run of `roboneuron runs list`."
        )
    if not damage or (about and not is_finished(path)):
        return ""
    return (
        f"{path} is cut off or damaged: {damage[0]}. What was written before is shown; "
        "`mcap recover` writes it to a whole file."
    )


def _time(at_ns: int) -> str:
    return (
        datetime.fromtimestamp(at_ns / 1e9, UTC).isoformat(timespec="milliseconds") if at_ns else ""
    )
