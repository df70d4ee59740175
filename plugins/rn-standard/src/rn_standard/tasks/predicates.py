"""Predicates: conditions for the end of a task, as data written by an agent."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from roboneuron import InvalidInputError

MOST_PARTS = 32
UNTIL = (
    '{"kind": K, ...}, by K: monitor (name: colour-lifted, options: {"colour": "red"}; '
    "object-in-region; scene-changed), tcp_in (lower_m, upper_m: [x, y, z]), joints_in (joints: "
    "{name: [low, high]}), "
    "gripper_holds, still (for_s), policy_done, field (topic, type, field; at_least, at_most or "
    "equals), "
    "held (for_s, of: P), not (of: P), all or any (of: [P, ...])"
)
"""All kinds in short form for an agent; monitors of other packages, and the schema, are in the
resource of predicates.
"""
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Point = Annotated[tuple[_Finite, _Finite, _Finite], Field(strict=False)]
_Seconds = Annotated[float, Field(gt=0, le=600)]


class _Predicate(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    def parts(self) -> tuple[Predicate, ...]:
        """The nested predicates."""
        return ()


class All(_Predicate):
    """Every part is true."""

    kind: Literal["all"]
    of: Annotated[tuple[Predicate, ...], Field(strict=False, min_length=1)]

    def parts(self) -> tuple[Predicate, ...]:
        """The parts."""
        return self.of


class AnyOf(_Predicate):
    """At least one part is true."""

    kind: Literal["any"]
    of: Annotated[tuple[Predicate, ...], Field(strict=False, min_length=1)]

    def parts(self) -> tuple[Predicate, ...]:
        """The parts."""
        return self.of


class Not(_Predicate):
    """The part is false."""

    kind: Literal["not"]
    of: Predicate

    def parts(self) -> tuple[Predicate, ...]:
        """The one part."""
        return (self.of,)


class Held(_Predicate):
    """The part has been true without interruption for a time."""

    kind: Literal["held"]
    of: Predicate
    for_s: _Seconds

    def parts(self) -> tuple[Predicate, ...]:
        """The one part."""
        return (self.of,)


class FieldIs(_Predicate):
    """A field of a ROS message has a value; bounds are inclusive."""

    kind: Literal["field"]
    topic: Annotated[
        str, Field(min_length=1, description="under the robot's namespace, or absolute")
    ]
    type: Annotated[
        str, Field(pattern=r"^\w+/msg/\w+$", description='such as "std_msgs/msg/Float64"')
    ]
    field: Annotated[
        str, Field(min_length=1, description='path, such as "pose.position.z" or "effort[7]"')
    ]
    at_least: _Finite | None = None
    at_most: _Finite | None = None
    equals: str | int | float | bool | None = None

    @model_validator(mode="after")
    def _check(self) -> FieldIs:
        if self.at_least is None and self.at_most is None and self.equals is None:
            raise ValueError("one of at_least, at_most and equals is needed")
        return self


class TcpIn(_Predicate):
    """The TCP is in a box, in the base frame."""

    kind: Literal["tcp_in"]
    arm: Annotated[str, Field(description="whose, of several arms")] = ""
    lower_m: _Point
    upper_m: _Point


class JointsIn(_Predicate):
    """Joints are within ranges [rad or m]."""

    kind: Literal["joints_in"]
    joints: Annotated[
        dict[str, Annotated[tuple[_Finite, _Finite], Field(strict=False)]],
        Field(min_length=1, description="[lowest, highest] by joint"),
    ]


class GripperHolds(_Predicate):
    """The gripper is closed on an object: its opening is within a range, and its effort is high
    enough.
    """

    kind: Literal["gripper_holds"]
    arm: Annotated[str, Field(description="whose, of several arms")] = ""
    least_open: Annotated[float, Field(ge=0, le=1)] = 0.1
    most_open: Annotated[float, Field(ge=0, le=1)] = 0.9
    least_effort: Annotated[
        float, Field(gt=0, description="of the gripper's joint [N or Nm]; not looked at without")
    ] | (None) = None


class Still(_Predicate):
    """No joint has moved for a time."""

    kind: Literal["still"]
    for_s: _Seconds


class PolicyDone(_Predicate):
    """The policy reports that it has finished."""

    kind: Literal["policy_done"]


class MonitorSays(_Predicate):
    """An installed monitor scores the observation at least this high."""

    kind: Literal["monitor"]
    name: Annotated[str, Field(min_length=1, description="of an installed monitor")]
    options: dict[str, object] = Field(default_factory=dict, description="of that monitor")
    at_least: Annotated[float, Field(gt=0, le=1)] = 0.9


Predicate = Annotated[
    All
    | AnyOf
    | Not
    | Held
    | FieldIs
    | TcpIn
    | JointsIn
    | GripperHolds
    | Still
    | PolicyDone
    | MonitorSays,
    Field(discriminator="kind"),
]
for _model in (All, AnyOf, Not, Held):
    _model.model_rebuild()
ADAPTER: TypeAdapter[Predicate] = TypeAdapter(Predicate)


def parse_predicate(data: object, path: str = "until") -> Predicate:
    """Parse a predicate from a caller's data.

    Raises:
        InvalidInputError: it is not a valid predicate, with the path and reason, or it has more
            than 32 parts.
    """
    try:
        predicate = ADAPTER.validate_python(data)
    except (ValidationError, RecursionError) as error:
        raise _explained(error, path) from error
    if len(flat(predicate)) > MOST_PARTS:
        raise InvalidInputError(f"The predicate has more than {MOST_PARTS} parts.", path=path)
    return predicate


def flat(predicate: Predicate) -> list[Predicate]:
    """The predicate and all nested ones."""
    return [predicate, *(inner for part in predicate.parts() for inner in flat(part))]


def _explained(error: ValidationError | RecursionError, path: str) -> InvalidInputError:
    if isinstance(error, RecursionError):
        return InvalidInputError("The predicate is nested too deeply.", path=path)
    first = error.errors(include_url=False)[0]
    place = ".".join([path, *(str(part) for part in first["loc"])])
    return InvalidInputError(
        f"{place} is {str(first['input'])[:80]!r}: {first['msg']}.",
        hint=f"Predicates are: {UNTIL}.",
        path=place,
    )
