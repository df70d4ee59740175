"""What judges a task: its predicate, with the robot's arms and the topics of its fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rn_standard.tasks.judging import MonitorFor, PredicateJudge
from rn_standard.tasks.predicates import (
    FieldIs,
    GripperHolds,
    Predicate,
    TcpIn,
    flat,
    parse_predicate,
)
from rn_standard.tasks.short_words import default_predicate, expanded
from roboneuron import (
    BackendSpec,
    ConfigurationError,
    Host,
    InvalidInputError,
    RefusedError,
    RobotProfile,
    Verb,
)
from roboneuron.direct_path import truth
from roboneuron.direct_path.fields import check_path, load_type
from roboneuron.feature import check_topic


def judge_of(
    predicate: Predicate,
    instruction: str,
    profile: RobotProfile | None,
    monitor_for: MonitorFor,
) -> PredicateJudge:
    """What judges a task. Raises InvalidInputError for an arm that the robot does not have."""
    arms = {} if profile is None else {arm.name: arm for arm in profile.arms}
    for part in flat(predicate):
        if isinstance(part, TcpIn | GripperHolds) and part.arm not in ("", *arms):
            raise InvalidInputError(
                f"There is no arm {part.arm[:64]!r}.",
                hint=f"The arms are: {', '.join(arms) or 'one without a name'}.",
                path="until",
            )
    grippers = {name: arm.gripper for name, arm in arms.items()}
    grippers[""] = None if profile is None else profile.gripper
    joints = {name: grip.joint for name, grip in grippers.items() if grip is not None}
    return PredicateJudge(predicate, instruction, monitor_for, joints)


def topics_of(predicate: Predicate) -> Mapping[str, str]:
    """Type by topic, for the fields in a predicate.

    Raises:
        InvalidInputError: a topic, type or field is invalid, or one topic is named with two types.
        RefusedError: a topic contains the simulator's ground truth.
    """
    topics: dict[str, str] = {}
    for part in flat(predicate):
        if isinstance(part, FieldIs):
            _check_field(part)
            if truth.is_withheld(part.topic):
                raise RefusedError(
                    f"{part.topic} carries what only the simulator knows.",
                    hint="Judge by the robot's own measurements or by a monitor.",
                    rule="simulator_truth",
                )
            if topics.setdefault(part.topic, part.type) != part.type:
                raise InvalidInputError(f"{part.topic} is named with two types.", path="until")
    return topics


def _check_field(part: FieldIs) -> None:
    try:
        check_topic(part.topic)
        check_path(load_type(part.type), part.field)
    except (ConfigurationError, InvalidInputError) as error:
        raise InvalidInputError(f"until: {error.message}", hint=error.hint, path="until") from error


def predicate_of(
    instruction: str, until: dict[str, object] | str | None, verbs: Sequence[Verb]
) -> Predicate | None:
    """What a task is judged by: `until`, if it is given, else its instruction's verb, if it is one
    of the policy's. Raises InvalidInputError.
    """
    asked = default_predicate(instruction, verbs) if until is None else until
    if isinstance(asked, str):
        asked = expanded(asked, instruction)
    return None if asked is None else parse_predicate(asked)


def backend_of(host: Host) -> BackendSpec | None:
    """Descriptor of the policy that runs, or else of the configured one; None without one that is
    installed here.
    """
    plan = host.modules.view("inference").plan
    section = (host.config if plan is None else plan.config).inference
    name = "" if section is None else section.backend
    specs = (offer.spec for offer in host.registry.offers(BackendSpec.kind))
    return next((s for s in specs if s.name == name and isinstance(s, BackendSpec)), None)


def unjudged(backend: BackendSpec | None) -> str:
    """Why an instruction is not judged by its verb."""
    if backend is None or not backend.verbs:
        who = "the policy" if backend is None else f"the policy {backend.name!r}"
        return f"{who} declares no verbs, and the call gave no `until`"
    words = ", ".join(word for verb in backend.verbs for word in verb.words)
    return (
        f"nothing judges this instruction by itself, and the call gave no `until`; the policy "
        f"{backend.name!r} declares: {words}"
    )
