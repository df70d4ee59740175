"""Runs episodes one after the other in this process."""

from __future__ import annotations

import os
import platform
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import cast
from zlib import crc32

import numpy as np

from rn_eval.episode import EpisodeClock
from rn_eval.latency import parse_latency
from rn_eval.plan import EvalPlan, Job, with_body
from rn_eval.policy import AgreedPolicy, EpisodePolicy, load_backend
from rn_eval.record import EpisodeOutcome, EpisodeRecord, MachineFacts
from rn_eval.suite import Setup
from rn_eval.versions import installed_versions
from roboneuron import EE_DELTA, BackendSpec, Controller, RoboNeuronError
from roboneuron.command import discover
from roboneuron.feature import build, load_profile, motion_rules
from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Mode
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.modules.inference.execution import Bounds

_DEFAULT_IMAGE_AGE_S = 0.5
_ERROR_LINES = 6


class Runner:
    """Holds what is kept between episodes: the suite, the controller and the policy of one preset.
    Used from one thread.

    Args:
        plan: the evaluation.
        connect: returns the policy of a preset; None loads it into this process.
    """

    def __init__(
        self, plan: EvalPlan, connect: Callable[[str], EpisodePolicy] | None = None
    ) -> None:
        self._plan = plan
        self._registry = discover()
        self._connect = connect or (lambda preset: load_backend(plan, self._registry, preset))
        self._suite = plan.build_suite(self._registry)
        self._preset: str | None = None
        self._policy: EpisodePolicy | None = None
        self._is_cold = True
        self._versions = installed_versions(plan, self._registry)
        self._agreement: SpaceAgreement | None = None
        self._setup, self._spec = self._prepare()

    def _prepare(self) -> tuple[Setup, BackendSpec]:
        plan, config = self._plan, self._plan.load_config()
        parts = plan.check(self._registry, plan.presets[0])
        profile = load_profile(
            with_body(self._registry, plan.suite_spec(self._registry)), parts.robot.name
        )
        controller: Controller | None = None
        if (spec := plan.controller(self._registry, parts.robot)) is not None:
            profile = replace(profile, collision=motion_rules(config.limits, profile).collision)
            controller = cast(
                "Controller",
                build(spec, config.options(spec.name), profile),
            )
            controller.load()
            if parts.backend.space is not None:
                options = {
                    **config.options(parts.backend.name),
                    **({} if plan.checkpoint is None else {"checkpoint": plan.checkpoint}),
                }
                self._agreement = SpaceAgreement.of(
                    self._registry, parts.backend, options, parts.robot.name, config.control
                )
        cameras = {role: profile.camera(name) for role, name in parts.cameras.items()}
        setup = Setup(
            profile=profile,
            cameras={role: camera for role, camera in cameras.items() if camera is not None},
            controller=controller,
            config=config,
            needs_state=parts.backend.needs_state,
            space=EE_DELTA if self._agreement is None else self._agreement.executed,
        )
        return setup, parts.backend

    def run(self, job: Job) -> tuple[EpisodeRecord, bytes | None]:
        """Run one episode; return its record, and the film strip if one is wanted.

        A crash of the simulator or the policy is an outcome ("error"), not an exception.

        Raises:
            RoboNeuronError: the policy cannot be loaded, so every episode would fail.
        """
        begun_s = time.perf_counter()
        policy = self._policy_of(job.key.preset)
        strip: bytes | None = None
        measured = MachineFacts()
        try:
            outcome, inference_ms, strip = self._play(job, policy)
            measured = MachineFacts(
                wall_s=round(time.perf_counter() - begun_s, 4),
                inference_ms=inference_ms,
                cold=int(self._is_cold),
            )
            self._is_cold = False
        except Exception as error:  # border to simulator and policy: other episodes continue
            lines = "".join(traceback.format_exception(error)).strip().splitlines()
            outcome = EpisodeOutcome(
                status="error", reason=" | ".join(line.strip() for line in lines[-_ERROR_LINES:])
            )
        record = EpisodeRecord(
            key=job.key,
            instruction=job.episode.instruction,
            outcome=outcome,
            measured=measured,
            host=platform.node(),
            pid=os.getpid(),
            ended_at=datetime.now(UTC).isoformat(timespec="milliseconds"),
            versions=self._versions,
        )
        return record, strip

    def _play(
        self, job: Job, policy: EpisodePolicy
    ) -> tuple[EpisodeOutcome, list[float], bytes | None]:
        random = np.random.default_rng([job.key.seed, crc32(job.key.task.encode())])
        if self._agreement is not None:
            policy = AgreedPolicy(policy, self._agreement)
        policy.reset()
        scene = self._suite.open(job.episode, self._setup)
        try:
            clock = EpisodeClock(
                scene=scene,
                policy=policy,
                executor=self._executor(job.key.execution),
                latency=parse_latency(job.key.latency)(random),
                episode=job.episode,
            )
            played = clock.run()
            is_wanted = self._plan.strips == "all" or (
                self._plan.strips == "failures" and played.outcome.status == "failure"
            )
            strip = None
            if is_wanted:
                end = next(iter(scene.observe(1).frames.values()), None)
                last = None if end is None else (played.outcome.duration_s, "end", end.image)
                strip = played.film.strip(last) or None
            return played.outcome, played.inference_ms, strip
        finally:
            scene.close()

    def _executor(self, execution: str) -> AdaptiveExecutor:
        inference = self._setup.config.inference
        most_s = inference.max_image_age_s if inference is not None else _DEFAULT_IMAGE_AGE_S
        fixed = None if execution == "auto" else cast("Mode", execution)
        return AdaptiveExecutor.of(self._spec, fixed=fixed, bounds=Bounds(first_s=most_s))

    def _policy_of(self, preset: str) -> EpisodePolicy:
        if self._policy is None or self._preset != preset:
            self.close_policy()
            self._policy, self._preset, self._is_cold = self._connect(preset), preset, True
        return self._policy

    def close_policy(self) -> None:
        """Release the loaded policy."""
        policy, self._policy = self._policy, None
        if policy is not None:
            policy.close()

    def close(self) -> None:
        """Release everything; may be called twice."""
        self.close_policy()
        self._suite.close()
        if self._setup.controller is not None:
            self._setup.controller.close()


def refuse_early(plan: EvalPlan) -> None:
    """Check as much as possible before anything is loaded.

    Raises:
        RoboNeuronError: a preset is not possible, or a latency or an option is invalid.
    """
    registry = discover()
    for preset in plan.presets:
        plan.check(registry, preset)
    for latency in plan.latencies:
        parse_latency(latency)
    spec = registry.get(BackendSpec, plan.backend)
    if spec.needs_checkpoint and plan.checkpoint is None:
        raise RoboNeuronError(
            f"The backend {plan.backend!r} needs a checkpoint.", hint="Give --checkpoint FOLDER."
        )
