"""Tools of robots with one arm or several: the argument `arm`, and a handler for each."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection, Mapping
from typing import Any, Generic, TypeVar, cast

from pydantic.json_schema import JsonSchemaValue

from roboneuron.direct_path.derived import Derived
from roboneuron.errors import InvalidInputError
from roboneuron.server.rehearsal import Needs, Rehearsable, Rehearsal
from roboneuron.server.tool import Arguments, CallContext, Reply, Result

A = TypeVar("A", bound=Arguments)
T = TypeVar("T")
H = TypeVar("H", bound=Callable[[Any, CallContext], Awaitable[Result | Reply]])


class OfArm(Generic[H]):
    """The handler of a tool for several arms, which passes a call on to that of its arm."""

    def __init__(self, handlers: Mapping[str, H]) -> None:
        """`handlers` are those of the arms, by name."""
        self._handlers = handlers

    def of(self, arm: str) -> H:
        """The one of that arm. Raises InvalidInputError."""
        return of_named_arm(self._handlers, arm)

    async def __call__(self, arguments: Any, context: CallContext) -> Result | Reply:
        """Raises as the handler; InvalidInputError also for an unknown arm."""
        return await self.of(arguments.arm)(arguments, context)

    @property
    def rehearsal_needs(self) -> Needs:
        """See `Rehearsable`; the same for each arm."""
        return cast("Rehearsable", next(iter(self._handlers.values()))).rehearsal_needs

    def rehearse(self, arguments: Any, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`."""
        cast("Rehearsable", self.of(arguments.arm)).rehearse(arguments, rehearsal)


def of_named_arm(by_arm: Mapping[str, T], arm: str) -> T:
    """Return the value of an arm. Raises InvalidInputError, which names the arms."""
    if arm not in by_arm:
        names = ", ".join(map(repr, by_arm))
        told = f"There is no arm {arm[:64]!r}" if arm else "The call names no arm"
        raise InvalidInputError(f"{told}; the arms are {names}.", path="arm")
    return by_arm[arm]


def handler_of(handlers: Mapping[str, H]) -> H | OfArm[H]:
    """The handler of the only arm, whose name is empty, or one for all."""
    return handlers[""] if _is_single(handlers) else OfArm(handlers)


def arguments_of(
    model: type[A], arms: Collection[str], omitted: Collection[str] = (), **more: JsonSchemaValue
) -> Derived[A]:
    """The arguments of a tool: `arm` is required for several arms, and left out for one.

    Args:
        model: with the field `arm`.
        arms: their names; one empty name for a single arm.
        omitted: fields that this robot has no use for.
        more: further schemas of fields.
    """
    fields = [name for name in model.model_fields if name not in omitted]
    properties: dict[str, JsonSchemaValue] = {name: more.get(name, {}) for name in fields}
    if _is_single(arms):
        del properties["arm"]
        return Derived(model=model, properties=properties, required=[])
    properties["arm"] = {"enum": [*arms]}
    return Derived(model=model, properties=properties, required=["arm"])


def _is_single(arms: Collection[str]) -> bool:
    return [*arms] == [""]
