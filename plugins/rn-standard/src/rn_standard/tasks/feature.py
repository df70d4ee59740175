"""The feature: tools of tasks, events as resources, prompts."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial

from rn_standard.tasks.approval import Approval, Subject
from rn_standard.tasks.arbiter import CHANGES_POLICY, TaskArbiter
from rn_standard.tasks.events import LEADS, MONITORS, TASKS, EventLog, Watching, check_thresholds
from rn_standard.tasks.history import MotionFacts, TaskHistory
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.journal import MotionJournal
from rn_standard.tasks.lifecycle import list_models_tool, start_all_tool
from rn_standard.tasks.move_to import MoveTo, move_to_subject, move_to_tool
from rn_standard.tasks.moving import Mover
from rn_standard.tasks.named_targets import Places, check_places
from rn_standard.tasks.options import TasksSections
from rn_standard.tasks.predicates import UNTIL
from rn_standard.tasks.prompts import offer_prompts
from rn_standard.tasks.run_task import TaskTool, run_task_tool
from rn_standard.tasks.runner import TaskEnd
from rn_standard.tasks.short_words import WORDS
from rn_standard.tasks.task_calls import TaskCalls
from rn_standard.teleoperation.feature import TELEOPERATION, Teleoperation
from roboneuron import (
    F64,
    CallContext,
    ConfigurationError,
    Feature,
    Host,
    InvalidInputError,
    NotReadyError,
    Resource,
    RoboNeuronError,
    Tool,
    matrix_from_quaternion,
)
from roboneuron.feature import CallPhase, Config, Interceptor, StillReason
from roboneuron.selection.options import NamedModelOptions
from roboneuron.sight.inputs import Inputs

EXAMPLES: dict[str, dict[str, object]] = {
    "the red cube is lifted and held for a second": {
        "kind": "held",
        "for_s": 1.0,
        "of": {
            "kind": "all",
            "of": [
                {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85},
                {
                    "kind": "monitor",
                    "name": "colour-lifted",
                    "options": {"colour": "red", "height_m": 0.1},
                },
            ],
        },
    },
    "the blue cube lies in a box on the table": {
        "kind": "monitor",
        "name": "object-in-region",
        "options": {"colour": "blue", "lower_m": [0.4, 0.1, 0.0], "upper_m": [0.6, 0.3, 0.1]},
    },
    "the arm is over the table and stands": {
        "kind": "all",
        "of": [
            {"kind": "tcp_in", "lower_m": [0.3, -0.3, 0.2], "upper_m": [0.7, 0.3, 0.6]},
            {"kind": "still", "for_s": 0.5},
        ],
    },
    "the policy says that it has finished": {"kind": "policy_done"},
    "the temperature is below 60": {
        "kind": "field",
        "topic": "motor_temperature",
        "type": "std_msgs/msg/Float64",
        "field": "data",
        "at_most": 60.0,
    },
}
"""Predicate by its meaning."""


PREDICATES_URI = "roboneuron://tasks/predicates"
_CLOSE_S = 3.0
_EXAMPLES = 3
"""Examples of predicates in their resource, which agents read whole."""
_POSE_S = 2.0


class TasksFeature(Feature[TasksSections]):
    """Adds start_all, list_models, run_task, list_tasks, move_to; events and past tasks as
    resources; prompts.
    """

    _arbiter: TaskArbiter | None = None
    _watching: Watching | None = None
    _journal: MotionJournal | None = None

    def check(self, config: Config) -> None:
        """See `Feature.check`."""
        try:
            check_places(self.options)
            check_thresholds(self.options.events)
        except InvalidInputError as error:
            raise ConfigurationError(error.message, hint=error.hint) from error

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        self._host = host
        arbiter = self._arbiter = TaskArbiter()
        host.events.stop.listen(lambda kind: arbiter.end(f"{kind} was stopped"))
        self._events = EventLog(self.options.events.kept, host.events.resource.tell)
        self._watching = Watching(host, self.options.events, self._events)
        self._history = TaskHistory(host.state_directory, robot=lambda: str(host.loop.robot_facts))
        self._journal = MotionJournal(host, self._history)
        places = Places(host, self.options)
        mover = Mover(host, places, self._pose_now)
        task = TaskTool(
            host,
            self.options.tasks,
            arbiter,
            mover,
            places.choices,
            self._note_end,
            self._note_failure,
            lambda facts: self._events.add(MONITORS, **facts),
        )
        subjects: dict[str, Subject] = {
            "run_task": task.subject,
            "move_to": partial(move_to_subject, places),
        }
        self._approval = Approval(self.options.tasks, subjects)
        return [
            start_all_tool(host),
            run_task_tool(task),
            self._history.tool(),
            self._journal.tool(),
            move_to_tool(MoveTo(host, mover, places, self._pose_now), places),
            *([list_models_tool(host)] if NamedModelOptions.all_of(host.config) else []),
        ]

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """See `Feature.interceptors`."""
        assert self._arbiter is not None
        return [
            Interceptor(
                name="task",
                phase=CallPhase.ARBITRATION,
                check=self._arbiter.check_idle,
                tools=CHANGES_POLICY,
            ),
            *self._approval.interceptors(),
        ]

    def resources(self, host: Host) -> Sequence[Resource]:
        """See `Feature.resources`."""
        return [
            Resource(
                uri=PREDICATES_URI,
                name="predicates",
                title="Predicates for run_task",
                description="Short words, kinds, three examples and monitors for `until`.",
                read=self._predicates,
                mime_type="application/json",
            ),
            self._history.resource(),
            *self._events.resources(),
        ]

    def complete(self, host: Host) -> None:
        """See `Feature.complete`."""
        feature = host.features.loaded.get(TELEOPERATION)
        if isinstance(feature, Teleoperation):
            feature.changes.append(
                lambda what, text: self._events.add(LEADS, what=what, explanation=text)
            )

    def attach(self, host: Host) -> None:
        """See `Feature.attach`."""
        offer_prompts(host.server)
        host.server.middleware.append(TaskCalls())

    def start(self, host: Host) -> None:
        """See `Feature.start`."""
        if self._watching is not None:
            self._watching.start()

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """See `Feature.still_reasons`."""
        if self._arbiter is None:
            return ()
        return (*self._arbiter.still_reasons(), *self._approval.still_reasons(asker))

    @property
    def motions(self) -> Sequence[str]:
        """See `Feature.motions`."""
        owner = "" if self._arbiter is None else self._arbiter.owner
        return (f"run_task {owner}",) if owner else ()

    def close(self) -> None:
        """End the running task, if any, and all subscriptions."""
        if self._journal is not None:
            self._journal.flush()
        if self._arbiter is not None:
            self._arbiter.end("the server ends", _CLOSE_S)
        if self._watching is not None:
            self._watching.close()

    def _note_end(self, instruction: str, end: TaskEnd) -> None:
        self._events.add(
            TASKS,
            instruction=instruction,
            outcome=end.outcome,
            attempts=end.attempts,
            reason=end.reason,
            took_s=round(end.took_s, 3),
            **({} if end.monitor is None else {"monitor": asdict(end.monitor)}),
        )
        facts = self._scene(end.took_s)
        if end.others_moved:
            facts["objects_moved"] = [
                {"object": name, "by_m": by_m} for name, by_m in end.others_moved.items()
            ]
        self._history.note(
            instruction,
            end.outcome,
            end.reason,
            attempts=end.attempts,
            took_s=end.took_s,
            **facts,
        )

    def _note_failure(self, instruction: str, error: RoboNeuronError) -> None:
        self._history.note(instruction, "error", str(error), **self._scene(0.0))

    def _scene(self, took_s: float) -> MotionFacts:
        """Model of a task that ended just now, and how fast it moved the arm."""
        plan = self._host.modules.view("inference").plan
        facts: MotionFacts = {"model": {} if plan is None else dict(plan.names)}
        speed = None if self._journal is None else self._journal.fastest_m_s(took_s)
        return facts if speed is None else facts | {"max_tcp_speed_m_s": speed}

    def _predicates(self) -> str:
        monitors = {
            name: spec.summary for name, spec in self._host.registry.specs(MonitorSpec).items()
        }
        shown = dict(list(EXAMPLES.items())[:_EXAMPLES])
        told = {"words": WORDS, "kinds": UNTIL, "examples": shown, "monitors": monitors}
        return json.dumps(told)

    def _pose_now(self, arm: str) -> tuple[F64, F64]:
        self._host.modules.require_running("control")
        inputs = Inputs(self._host)
        inputs.open(inputs.pose_topic(arm), "geometry_msgs/msg/PoseStamped")
        try:
            deadline_s = time.monotonic() + _POSE_S
            while (pose := inputs.pose(arm)) is None:
                if time.monotonic() > deadline_s:
                    raise NotReadyError(
                        f"Control runs, but no pose of the end effector came within {_POSE_S:g} s.",
                        hint="The machine may be overloaded: see get_status, and call again.",
                    )
                time.sleep(0.01)
        finally:
            inputs.close()
        return pose.position_m, matrix_from_quaternion(pose.quaternion_xyzw)
