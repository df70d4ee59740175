"""Parts of a run in which a person moved the arm: listed, or extracted as episodes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rn_recorder_runs.acted import LED
from rn_recorder_runs.episodes import RecordedEpisode, read_episodes
from rn_recorder_runs.store import Run


@dataclass(frozen=True, kw_only=True, slots=True)
class Intervention:
    """Consecutive rows in which a person moved the arm.

    Attributes:
        run, instruction: those of the episode.
        episode: number in its run, from 0.
        first, rows: first row in the episode, and number of rows.
        who: "person", "blend", or both with a comma between.
        begun_ns: time of its first action [ns].
        duration_s: to the last one.
        outcome: outcome of the episode.
    """

    run: str
    episode: int
    instruction: str
    first: int
    rows: int
    who: str
    begun_ns: int
    duration_s: float
    outcome: str


def spans(episode: RecordedEpisode) -> list[range]:
    """Row numbers of each span."""
    found: list[range] = []
    for number, row in enumerate(episode.rows):
        if row.who not in LED:
            continue
        if found and found[-1].stop == number:
            found[-1] = range(found[-1].start, number + 1)
        else:
            found.append(range(number, number + 1))
    return found


def cut(episodes: Sequence[RecordedEpisode]) -> list[RecordedEpisode]:
    """Extract each span as a separate episode."""
    return [
        replace(episode, rows=episode.rows[span.start : span.stop])
        for episode in episodes
        for span in spans(episode)
    ]


def interventions(run: Run) -> list[Intervention]:
    """All interventions of a run. Raises InvalidInputError for one without images or actions."""
    found = []
    episodes, _ = read_episodes(run.id, run.files, run.facts)
    for number, episode in enumerate(episodes):
        for span in spans(episode):
            rows = episode.rows[span.start : span.stop]
            words = {row.who: None for row in rows}
            found.append(
                Intervention(
                    run=run.id,
                    episode=number,
                    instruction=episode.instruction,
                    first=span.start,
                    rows=len(rows),
                    who=",".join(words),
                    begun_ns=rows[0].sent_ns,
                    duration_s=(rows[-1].sent_ns - rows[0].sent_ns) / 1e9,
                    outcome=episode.outcome,
                )
            )
    return found


def to_text(found: Sequence[Intervention], as_json: bool) -> str:
    """Format for users, or for programs."""
    if as_json:
        names = Intervention.__slots__
        return json.dumps([{name: getattr(one, name) for name in names} for one in found], indent=1)
    lines = [
        f"{one.run:<52} episode {one.episode:>3} rows {one.first:>5} .. "
        f"{one.first + one.rows - 1:<5} {one.duration_s:>6.1f} s  {one.who:<12} "
        f"{one.outcome:<10} {one.instruction}"
        for one in found
    ]
    return "\n".join(lines) or "Nobody has led the arm in these runs."
