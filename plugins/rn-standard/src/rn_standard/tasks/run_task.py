"""Tool run_task."""

from __future__ import annotations

import json
import threading
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import replace
from typing import cast

from pydantic import Field

from rn_standard.tasks.arbiter import TaskArbiter
from rn_standard.tasks.guarded import SLOW_S, AskedMonitor
from rn_standard.tasks.hooks import MonitorSpec
from rn_standard.tasks.judging import MonitorFor, PredicateJudge
from rn_standard.tasks.live import LiveCell
from rn_standard.tasks.monitor import Monitor, RememberingMonitor
from rn_standard.tasks.options import TaskOptions
from rn_standard.tasks.predicates import (
    UNTIL,
    GripperHolds,
    MonitorSays,
    Predicate,
    flat,
)
from rn_standard.tasks.runner import Outcome, Task, TaskEnd, TaskPlan
from rn_standard.tasks.short_words import WORDS
from rn_standard.tasks.task_judge import backend_of, judge_of, predicate_of, topics_of, unjudged
from rn_standard.tasks.task_result import TaskResult, task_result
from rn_standard.tasks.task_watch import Notify, TaskWatch, WatchMaker
from roboneuron import (
    Arguments,
    CallContext,
    Host,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    Reply,
    RoboNeuronError,
    RobotProfile,
    StateError,
    Tool,
)
from roboneuron.feature import Stage, build, loading
from roboneuron.modules.inference.instruction_text import InstructionText
from roboneuron.selection.restricted import restricted_values
from roboneuron.tools.arm.displacement import SceneWatch
from roboneuron.tools.arm.grip import check_gripper

HOLD, STOP = "hold", "stop"
"""Actions at the end of a task, in addition to the names of postures and places."""
_EVIDENCE = 2
_MOST_MONITORS = 16
MoveTo = Callable[[str, CallContext], Awaitable[object]]


class RunTask(Arguments):
    """Arguments of run_task."""

    instruction: InstructionText = Field(
        description='What to do: "pick up the red cube".',
    )
    until: dict[str, object] | str | None = Field(
        default=None,
        description=f"Success condition: {WORDS}, or a predicate P: {UNTIL}. Without it, the "
        "policy's own verbs (list_backends) are judged by themselves.",
    )
    max_s: float | None = Field(
        default=None, gt=0, le=86400, description="Longest time of one attempt [s]."
    )
    max_attempts: int | None = Field(default=None, ge=1, le=20, description="Most attempts.")
    on_end: str = Field(
        default=HOLD,
        max_length=64,
        description="At the end: hold, stop (the policy), or a name of move_to.",
    )


class TaskTool:
    """The handler of run_task."""

    def __init__(
        self,
        host: Host,
        options: TaskOptions,
        arbiter: TaskArbiter,
        move_to: MoveTo,
        names: Callable[[], Iterable[str]],
        ended: Callable[[str, TaskEnd], object],
        failed: Callable[[str, RoboNeuronError], object],
        contrary: Notify,
    ) -> None:
        """Args:
        host, options, arbiter: those of the feature.
        move_to: moves to a posture or place, for `on_end`.
        names: returns the names known to `move_to`.
        ended: called at every task's end, with its instruction.
        failed: called for a task that could not be executed.
        contrary: called when the configured monitor contradicts a predicate.
        """
        self._host = host
        self._options = options
        self._arbiter = arbiter
        self._move_to = move_to
        self._names = names
        self._ended = ended
        self._failed = failed
        self._monitors: dict[str, Monitor] = {}
        self._watches: WatchMaker | None = None
        if watching := options.monitor.name:
            # an unknown name is a mistake of the configuration, found before anything is served
            spec = host.registry.get(MonitorSpec, watching)
            self._watches = WatchMaker(
                lambda: cast("Monitor", build(spec, options.monitor.options)),
                options.monitor,
                spec.limit_s,
                contrary,
            )

    def is_offered(self) -> bool:
        """True if any policy could move the present robot."""
        return self._host.loop.takes_policies()

    async def __call__(self, arguments: RunTask, context: CallContext) -> Reply:
        """Raises InvalidInputError, RefusedError, StateError, NotReadyError."""
        instruction = arguments.instruction
        predicate, profile, judge = self._checked(arguments, self._remembered_monitor)
        topics = {} if predicate is None else topics_of(predicate)
        plan = self._plan(arguments)
        with self._host.loop.starts.claims.admit(instruction):
            pass  # before anything is waited for; asked again when the instruction is given
        halt = threading.Event()
        arm_stops = self._host.loop.starts.arm_stops

        def work(stage: Stage) -> TaskEnd:
            cameras, why = self._cameras(predicate), lambda: self._arbiter.reason
            cell = LiveCell(self._host, profile, context.role, stage, halt, why, topics, cameras)
            # looks are taken without the claim: they cannot be cancelled
            scene = SceneWatch(self._host, instruction, context.who)
            scene.look_before()
            if arguments.until is None and _lifts(predicate):
                scene.check_hands()
            if halt.is_set():
                raise StateError("The call was cancelled before the task began.")
            with self._arbiter.claim(f"{instruction!r} of {context.who}", halt):
                watch = self._watch(instruction)
                try:
                    cell.open()
                    end = Task(cell, judge, plan, stage, watch).run()
                finally:
                    cell.close()
                    if watch is not None:
                        watch.close()
            if end.outcome is not Outcome.STOPPED and end.attempts:
                end = _seen(end, scene, cameras)
            self._ended(instruction, end)
            return end

        try:
            end = await context.run(work, on_cancel=halt.set, on_leave=halt.set)
        except RoboNeuronError as error:
            self._failed(instruction, error)
            raise
        ended_with = await self._finish(arguments.on_end, end, context, arm_stops)
        return Reply(result=task_result(end, ended_with), pictures=(*end.before, *end.after))

    def subject(self, arguments: RunTask) -> tuple[str, str]:
        """What a person is asked to approve, see `Approval`. Raises as a call; monitors remember
        nothing of it.
        """
        self._checked(arguments, self._new_monitor)
        return "carry out", arguments.instruction

    def _checked(
        self, arguments: RunTask, monitor_for: MonitorFor
    ) -> tuple[Predicate | None, RobotProfile | None, PredicateJudge | None]:
        """The predicate, the robot and the judge of a task that could be carried out now."""
        profile = profile_of(self._host)
        predicate = self._predicate(arguments, profile)
        known = [HOLD, STOP, *self._names()]
        if arguments.on_end not in known:
            raise InvalidInputError(
                f"on_end is {arguments.on_end[:64]!r}.",
                hint=f"Choose one of: {', '.join(known)}.",
                path="on_end",
            )
        if predicate is not None:
            topics_of(predicate)
        judge = (
            None
            if predicate is None
            else judge_of(predicate, arguments.instruction, profile, monitor_for)
        )
        for kind in ("robot", "control"):
            self._host.modules.require_running(kind)
        self._check_grippers(predicate, profile)
        return predicate, profile, judge

    async def _finish(self, on_end: str, end: TaskEnd, context: CallContext, arm_stops: int) -> str:
        """Perform the action at the end; its failure does not change the outcome.

        Args:
            on_end, end, context: of the call.
            arm_stops: number of stops when it began; another one since ends the call's motions.
        """
        if on_end == HOLD or end.outcome is Outcome.STOPPED:
            return HOLD
        if self._host.loop.starts.arm_stops != arm_stops:
            return f"{HOLD}: there was a stop: {self._host.loop.starts.reason}"
        try:
            if on_end == STOP:
                await context.run(lambda _: self._host.loop.stop("inference"))
            else:  # the policy has no instruction any more
                await self._move_to(on_end, context)
        except RoboNeuronError as error:
            return f"{HOLD}: {on_end!r} was not possible: {error}"
        return on_end

    def rehearsal(
        self, arguments: RunTask, profile: RobotProfile
    ) -> tuple[PredicateJudge | None, TaskPlan]:
        """What a call is judged by, and its bounds, for a cell that is simulated: what monitors
        remember of the robot's own is neither used nor changed. Raises InvalidInputError,
        RefusedError.
        """
        plan = self._plan(arguments)
        predicate = self._predicate(arguments, profile)
        if predicate is None:
            return None, plan
        topics_of(predicate)
        judge = judge_of(predicate, arguments.instruction, profile, self._new_monitor)
        self._check_grippers(predicate, profile)
        return judge, plan

    def _predicate(self, arguments: RunTask, profile: RobotProfile | None) -> Predicate | None:
        """What a call is judged by; without a gripper, no verb is judged by itself."""
        if arguments.until is not None:
            return predicate_of(arguments.instruction, arguments.until, ())
        backend = backend_of(self._host)
        predicate = predicate_of(
            arguments.instruction, None, () if backend is None else backend.verbs
        )
        try:
            self._check_grippers(predicate, profile)
        except RefusedError:
            return None
        return predicate

    def _check_grippers(self, predicate: Predicate | None, profile: RobotProfile | None) -> None:
        """Raise RefusedError if a predicate asks for a gripper that is not there: it would never
        become true.
        """
        for part in _parts(predicate):
            if isinstance(part, GripperHolds):
                check_gripper(self._host, profile, part.arm)

    def _plan(self, arguments: RunTask) -> TaskPlan:
        options = self._options
        return TaskPlan(
            instruction=arguments.instruction,
            max_s=arguments.max_s or options.max_s,
            max_attempts=arguments.max_attempts or options.max_attempts,
            period_s=options.period_s,
            end_wait_s=options.end_wait_s,
            give_up_s=options.give_up_s,
            unjudged=unjudged(backend_of(self._host)) if arguments.until is None else "",
        )

    def _new_monitor(self, predicate: MonitorSays) -> Monitor:
        spec = self._host.registry.get(MonitorSpec, predicate.name)
        if not spec.in_predicates:
            raise RefusedError(
                f"Monitor {predicate.name!r} is not for predicates.",
                hint="Only [tasks.monitor] of the configuration may choose it.",
                rule="configuration",
            )
        _check_may_set(spec, predicate.options)
        if spec.limit_s > SLOW_S:
            return AskedMonitor(
                lambda: cast("Monitor", build(spec, predicate.options)), spec.limit_s
            )
        return cast("Monitor", build(spec, predicate.options))

    def _watch(self, instruction: str) -> TaskWatch | None:
        if self._watches is None:
            return None
        spec = self._host.registry.get(MonitorSpec, self._options.monitor.name)
        roles = self._host.loop.camera_roles().values()
        missing = [role for role in spec.cameras if role not in roles]
        why = f"there is no camera of role {missing[0]!r}" if missing else ""
        return self._watches.watch(instruction, why)

    def _remembered_monitor(self, predicate: MonitorSays) -> Monitor:
        spec = self._host.registry.get(MonitorSpec, predicate.name)
        monitor = self._new_monitor(predicate)
        key = f"{spec.target} {json.dumps(predicate.options, sort_keys=True, default=str)}"
        if isinstance(monitor, RememberingMonitor):
            if (previous := self._monitors.pop(key, None)) is not None:
                monitor.follow(previous)
            self._monitors[key] = monitor
            self._monitors = dict(list(self._monitors.items())[-_MOST_MONITORS:])
        return monitor

    def _cameras(self, predicate: Predicate | None) -> list[str]:
        """Cameras of the monitors, and those of the evidence."""
        roles = self._host.loop.camera_roles()
        names = list(self._options.evidence_cameras or list(roles)[:_EVIDENCE])
        if watching := self._options.monitor.name:
            spec = self._host.registry.get(MonitorSpec, watching)
            names += _of_roles(roles, (*spec.cameras, *spec.optional_cameras), names)
        for part in _parts(predicate):
            if isinstance(part, MonitorSays):
                spec = self._host.registry.get(MonitorSpec, part.name)
                absent = [role for role in spec.cameras if role not in roles.values()]
                if absent:
                    raise NotReadyError(
                        f"Monitor {part.name!r} needs a camera of role {absent[0]!r}; there is "
                        "none."
                    )
                names += _of_roles(roles, (*spec.cameras, *spec.optional_cameras), names)
        return names


def _lifts(predicate: Predicate | None) -> bool:
    """True if a verb of the policy is judged by what the hand holds at the end."""
    return any(isinstance(part, GripperHolds) for part in _parts(predicate))


def _parts(predicate: Predicate | None) -> Iterable[Predicate]:
    return () if predicate is None else flat(predicate)


def _seen(end: TaskEnd, scene: SceneWatch, cameras: list[str]) -> TaskEnd:
    """The end with what the scene shows: what was pushed, and pictures with names."""
    others_moved = scene.moved()
    pictures = scene.pictures(cameras)
    if pictures is not None and all(len(each) == len(end.after) for each in pictures):
        before, after = pictures
        end = replace(end, before=tuple(before), after=tuple(after))
    return replace(end, others_moved=others_moved)


def _check_may_set(spec: MonitorSpec, options: Mapping[str, object]) -> None:
    """Refuse options that only the configuration may set: files, hosts, secrets.

    Raises:
        RefusedError: names the options.
    """
    if spec.config is None:
        return
    barred = sorted(restricted_values(loading.load_options_model(spec), options))
    if barred:
        raise RefusedError(
            f"Only the configuration may set {', '.join(barred)} of monitor {spec.name!r}.",
            hint="A person can name the monitor in [tasks.monitor], with these options.",
            rule="configuration",
        )


def _of_roles(roles: Mapping[str, str], wanted: Iterable[str], known: list[str]) -> list[str]:
    """Names of cameras with these roles that are not yet known."""
    return [name for name, role in roles.items() if role in wanted and name not in known]


def profile_of(host: Host) -> RobotProfile | None:
    """Profile of the present robot; None without a plugin for it, and without the direct path."""
    name = host.config.robot.name
    try:
        exposed = host.gate.exposed
    except StateError:
        return None
    return next((e.profile for e in exposed if e.profile is not None and e.robot == name), None)


def run_task_tool(handler: TaskTool) -> Tool[RunTask]:
    """run_task."""
    return Tool(
        name="run_task",
        title="Carry out a task",
        description="Have the robot carry out an instruction; returns when the policy no longer "
        "moves it: succeeded, failed, timed_out, stopped (by someone) or unclear (judge by the "
        "images). Needs start_all. Cancelling, or losing the connection, stops the arm.",
        arguments=RunTask,
        result=TaskResult,
        handler=handler,
        simulated_by=frozenset({"twin"}),
        open_world=True,
        offered=handler.is_offered,
    )
