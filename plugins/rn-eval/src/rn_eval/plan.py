"""Definition of an evaluation: the plan, its variants, and the key of each episode. Stored as JSON
next to the ledger.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from rn_eval.hooks import SuiteSpec
from rn_eval.latency import digest_of
from rn_eval.suite import Episode, Suite
from roboneuron import ConfigurationError, ControllerSpec, RobotSpec
from roboneuron.command import Offer, Status
from roboneuron.feature import Config, Registry, build
from roboneuron.modules.control.planning import find_controller
from roboneuron.modules.inference.planning import ResolvedPolicy

NO_PRESET = "none"
_SAMPLE_BYTES = 65536


class Variant(NamedTuple):
    """One row of the comparison.

    Attributes:
        preset: acceleration preset, or "none".
        execution: execution mode of chunks: "sequential", "overlap", "rtc", "predicted-state" or
            "auto".
        latency: see `rn_eval.latency`.
    """

    preset: str
    execution: str
    latency: str


class Key(BaseModel):
    """Identifies an episode within a run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    suite: str
    preset: str
    execution: str
    latency: str
    task: str
    seed: int

    @property
    def variant(self) -> Variant:
        """The variant of the episode."""
        return Variant(preset=self.preset, execution=self.execution, latency=self.latency)

    @property
    def slug(self) -> str:
        """Name for files."""
        plain = "_".join(str(value) for _, value in self)
        safe = "".join(c if c.isalnum() or c in "._-" else "-" for c in plain)
        return safe if safe == plain else f"{safe}-{hashlib.sha256(plain.encode()).hexdigest()[:6]}"


class Job(NamedTuple):
    """One episode to run."""

    key: Key
    episode: Episode


class EvalPlan(BaseModel):
    """Everything that determines the episodes of a run and their outcomes.

    Attributes:
        suite: name of the suite.
        suite_options: as given; validated by the suite's own model.
        backend, checkpoint, runtime: the policy.
        checkpoint_sha256: hash over names, sizes and both ends of the checkpoint's files; ""
            without one.
        config: the configuration with limits, control and plugin options.
        executions, latencies, presets: every combination is a variant.
        latency_sha256: hash of the file of each latency that has one.
        episodes, first_seed: for `Suite.episodes`.
        shared_policy: predictions are made in batches of concurrent requests, so an episode does
            not repeat bit for bit.
        threads: threads of each worker's numerical libraries; some results depend on it.
        versions: package versions at the start of the run; see `rn_eval.versions`.
        later_versions: other versions with which it was continued (--other-versions), oldest first.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    suite: str
    suite_options: dict[str, object] = Field(default_factory=dict)
    backend: str
    checkpoint: str | None = None
    checkpoint_sha256: str = ""
    runtime: str | None = None
    config: dict[str, object]
    presets: tuple[str, ...] = (NO_PRESET,)
    executions: tuple[Literal["sequential", "overlap", "rtc", "predicted-state", "auto"], ...] = (
        "sequential",
    )
    latencies: tuple[str, ...] = ("0",)
    latency_sha256: dict[str, str] = Field(default_factory=dict)
    episodes: int = Field(ge=1)
    first_seed: int = Field(default=0, ge=0)
    shared_policy: bool = False
    threads: int = Field(default=1, ge=1)
    strips: Literal["failures", "all", "none"] = "failures"
    versions: dict[str, str] = Field(default_factory=dict)
    later_versions: tuple[dict[str, str], ...] = ()

    @property
    def identity(self) -> dict[str, object]:
        """Fields that must be equal to continue a ledger; more episodes and variants may be
        added.
        """
        growing = {
            "presets",
            "executions",
            "latencies",
            "latency_sha256",
            "episodes",
            "versions",
            "later_versions",
            "strips",
        }
        return self.model_dump(mode="json", exclude=growing)

    @property
    def parts(self) -> dict[str, str]:
        """SHA-256 of each file of latencies; all other names of variants say what they are."""
        return {f"latency {name!r}": digest for name, digest in self.latency_sha256.items()}

    def continued_by(self, now: EvalPlan) -> EvalPlan:
        """Return the plan `now` with the latencies of earlier variants, because their episodes
        stay in the ledger.
        """
        known = {**self.latency_sha256, **now.latency_sha256}
        return now.model_copy(update={"latency_sha256": known})

    def with_latencies(self) -> EvalPlan:
        """Return the plan with the present content of its files of latencies.

        Raises:
            ConfigurationError: one of them cannot be read.
        """
        found = {name: digest_of(name) for name in self.latencies}
        return self.model_copy(
            update={"latency_sha256": {name: digest for name, digest in found.items() if digest}}
        )

    @property
    def variants(self) -> tuple[Variant, ...]:
        """All variants, grouped by preset, so that a worker seldom loads another one."""
        return tuple(
            Variant(p, e, x) for p in self.presets for e in self.executions for x in self.latencies
        )

    def load_config(self) -> Config:
        """The configuration as a model."""
        return Config.model_validate(self.config)

    def suite_spec(self, registry: Registry) -> SuiteSpec:
        """The suite's descriptor. Raises ConfigurationError if it is not installed."""
        return registry.get(SuiteSpec, self.suite)

    def build_suite(self, registry: Registry) -> Suite:
        """Build the suite with its options. Raises ConfigurationError for invalid ones."""
        spec = self.suite_spec(registry)
        suite: Any = build(spec, self.suite_options)
        return suite  # type: ignore[no-any-return]

    def check(self, registry: Registry, preset: str) -> ResolvedPolicy:
        """Check the combination, as a server does before a start.

        Raises:
            ConfigurationError, PlanningError: it is not possible; one sentence.
        """
        spec, config = self.suite_spec(registry), self.load_config()
        policy = ResolvedPolicy.of(
            with_body(registry, spec),
            robot=spec.robot if spec.body is None else spec.body.name,
            driver=spec.driver,
            backend=self.backend,
            runtime=self.runtime,
            acceleration=None if preset == NO_PRESET else preset,
            cameras=config.inference.cameras if config.inference else {},
        )
        self.controller(registry, policy.robot)
        return policy

    def controller(self, registry: Registry, robot: RobotSpec) -> ControllerSpec | None:
        """The robot's controller; None in a suite whose body executes actions itself.

        Raises:
            ConfigurationError, PlanningError: it is not installed, or does not support the robot.
        """
        if self.suite_spec(registry).body is not None:
            return None
        section = self.load_config().control
        assert section is not None
        return find_controller(registry, section.controller, robot)

    def jobs(self, episodes: Sequence[Episode]) -> Iterator[Job]:
        """Every episode with every variant."""
        for variant in self.variants:
            for episode in episodes:
                key = Key(
                    suite=self.suite, **variant._asdict(), task=episode.task, seed=episode.seed
                )
                yield Job(key, episode)


def with_body(registry: Registry, spec: SuiteSpec) -> Registry:
    """The installed plugins, plus the robot that exists only in the suite's simulation."""
    if spec.body is None:
        return registry
    body = Offer(spec=spec.body, plugin="", distribution="", status=Status.READY)
    return replace(registry, all_offers=(*registry.all_offers, body))


def fingerprint(checkpoint: str | None) -> str:
    """Hash of names, sizes and the first and last 64 KiB of a checkpoint's files; "" without a
    checkpoint.

    Raises:
        ConfigurationError: there is no such file or folder.
    """
    if checkpoint is None:
        return ""
    root = Path(checkpoint)
    if not root.exists():
        raise ConfigurationError(f"There is no checkpoint {checkpoint!r}.")
    digest = hashlib.sha256()
    for path in sorted(p for p in ([root] if root.is_file() else root.rglob("*")) if p.is_file()):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(root)} {size}\n".encode())
        with path.open("rb") as file:
            digest.update(file.read(_SAMPLE_BYTES))
            file.seek(max(0, size - _SAMPLE_BYTES))
            digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()
