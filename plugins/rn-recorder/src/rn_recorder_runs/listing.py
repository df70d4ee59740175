"""Output of `roboneuron runs list` and `runs show`."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime
from typing import Any

from rn_recorder_runs.files import read_about
from rn_recorder_runs.reading import count_topics, iterate
from rn_recorder_runs.store import Run, RunStore, decoded_event


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
        what = " ".join(str(row[key]) for key in ("state", "outcome", "note") if row[key])
        size = f"{row['size_bytes'] / 1e6:.1f} MB"
        print(
            f"{row['id']:<52} {row['kind']:<9} {row['duration_s']:>7.1f} s {size:>11} "
            f"{row['messages']:>8}  {what}"
        )
    if not rows:
        print(f"There are no runs in {store.directory}.")
    return 0


def show_run(run: Run, as_json: bool) -> int:
    """Print the content of a run."""
    topics = count_topics(run.files)
    about = read_about(run.files[0]) if run.files else {}
    events = []
    for found in iterate(run.files, lambda topic: topic.startswith("/roboneuron/")):
        events.append(
            {
                "topic": found.record.topic,
                "at_ns": found.record.publish_ns,
                **decoded_event(found.message.data),
            }
        )
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
        return 0
    print(
        f"{run.id} ({run.kind}), robot {about.get('robot', '?')}, images {about.get('images', '?')}"
    )
    for path in run.files:
        print(f"  {path}")
    print(f"\n{'topic':<46} {'type':<34} {'count':>7} {'rate':>8} {'lost':>5}")
    for topic, counts in topics.items():
        span_s = (counts.last_ns - counts.first_ns) / 1e9
        rate = f"{(counts.messages - 1) / span_s:.1f} Hz" if span_s > 0 else ""
        lost = "?" if counts.lost is None else str(counts.lost)
        print(f"{topic:<46} {counts.type:<34} {counts.messages:>7} {rate:>8} {lost:>5}")
    print()
    for event in events:
        facts = {
            k: v for k, v in event.items() if k not in ("topic", "at_ns", "time", "time_ns") and v
        }
        print(f"{_time(event['at_ns'])} {json.dumps(facts)[:160]}")
    return 0


def _time(at_ns: int) -> str:
    return (
        datetime.fromtimestamp(at_ns / 1e9, UTC).isoformat(timespec="milliseconds") if at_ns else ""
    )
