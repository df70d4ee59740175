"""One line of the ledger: an episode's outcome, its measurements, and where it ran."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from rn_eval.plan import Key


class EpisodeOutcome(BaseModel):
    """Results that repeat bit for bit on a stepped clock or with injected latency.

    Attributes:
        status: "error" is a crash of simulator, policy or worker: it counts neither as success nor
            as failure.
        reason: one sentence unless it succeeded.
        duration_s: simulated duration [s].
        predictions, rows: number of predictions started, and of actions executed.
        refusals: number of predictions that the policy refused.
        limited: number of actions by effect of the limits.
        answers: number of chunks by result (accepted, late ...).
        starved_periods: periods without an action to execute.
        modes: number of answered predictions by the execution mode at their start.
        metrics: mean of each number that the backend reports ("tokens_kept").
        facts: facts from the suite's judge.
        digest: SHA-256 of all executed actions and of the simulator's last state.
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
    """Measurements that depend on the machine.

    Attributes:
        wall_s: duration of the whole episode [s].
        inference_ms: duration of each prediction in order [ms].
        cold: number of first predictions, right after loading, that are left out of statistics.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    wall_s: float = 0.0
    inference_ms: list[float] = Field(default_factory=list)
    cold: int = 0


class EpisodeRecord(BaseModel):
    """One episode.

    Attributes:
        key: identifies the episode.
        instruction: the policy's instruction.
        outcome, measured: see `EpisodeOutcome` and `MachineFacts`.
        strip: name of the film strip in the folder `strips`; "" without one.
        host, pid, ended_at: machine, process, and end time (UTC, ISO 8601).
        versions: package versions in the process that ran it; see `rn_eval.versions`. Empty in old
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
