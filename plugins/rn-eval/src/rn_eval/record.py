"""One line of the ledger: what an episode came to, what was measured, and where it ran."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from rn_eval.plan import Key


class EpisodeOutcome(BaseModel):
    """What repeats bit for bit on a stepped clock or with injected latency.

    Attributes:
        status: "error" is a crash of simulator, policy or worker: it counts neither as success nor
            as failure.
        reason: one sentence unless it succeeded.
        duration_s: simulated seconds.
        predictions, rows: inferences begun, and actions played.
        refusals: predictions that the policy refused to make.
        limited: actions by what the limits did to them.
        answers: chunks by what became of them (accepted, late ...).
        starved_periods: periods without an action to play.
        modes: answered predictions by the execution mode that they were begun in.
        metrics: mean of each number that the backend tells ("tokens_kept").
        facts: of the suite's judge.
        digest: SHA-256 of all actions played and of the simulator's last state.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    status: Literal["success", "failure", "error"]
    reason: str = ""
    duration_s: float = 0.0
    predictions: int = 0
    rows: int = 0
    refusals: int = 0
    limited: dict[str, int] = Field(default_factory=dict)
    answers: dict[str, int] = Field(default_factory=dict)
    starved_periods: int = 0
    modes: dict[str, int] = Field(default_factory=dict)
    metrics: dict[str, float] = Field(default_factory=dict)
    facts: dict[str, str | float] = Field(default_factory=dict)
    digest: str = ""


class MachineFacts(BaseModel):
    """What depends on the machine.

    Attributes:
        wall_s: the whole episode [s].
        inference_ms: each prediction in order [ms].
        cold: of these the first so many came right after loading and are left out of statistics.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    wall_s: float = 0.0
    inference_ms: list[float] = Field(default_factory=list)
    cold: int = 0


class EpisodeRecord(BaseModel):
    """One episode.

    Attributes:
        key: which one.
        instruction: what the policy was told.
        outcome, measured: see there.
        strip: name of the film strip in the folder `strips`; "" without one.
        host, pid, ended_at: where it ran, and when it ended (UTC, ISO 8601).
        versions: of the packages in the process that ran it; see `rn_eval.versions`. Empty in old
            ledgers.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: Key
    instruction: str
    outcome: EpisodeOutcome
    measured: MachineFacts = MachineFacts()
    strip: str = ""
    host: str = ""
    pid: int = 0
    ended_at: str = ""
    versions: dict[str, str] = Field(default_factory=dict)
