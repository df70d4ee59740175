"""Assignment of constants to the fields whose values they name.

ROS declares constants per message, not per field, so the link has to be inferred. Three rules,
first match wins, and a constant without a match is only mentioned in the description. A field still
accepts every number of its type: constants may be flags to be added (`NavSatStatus.service`) or
incomplete.

1. Prefix: `POWER_SUPPLY_STATUS_FULL` belongs to `power_supply_status`, `COVARIANCE_TYPE_KNOWN` to
   `position_covariance_type`: the constant starts with the last words of the field's name. The
   longest match wins.
2. Only holder: what is left belongs to the only integer field of the message, or to the only one
   whose name ends in a word that stands for a choice (type, status, state, mode, level, action,
   code ...).
3. Same order: several such fields and as many runs of ascending constants are paired in the order
   of the definition (`Marker`: ARROW=0 .. ARROW_STRIP=12, then ADD=0 .. DELETEALL=3, for `type` and
   `action`).

Rule 2 needs distinct values. Where rules 2 and 3 place nothing they are tried again without the
constants that qualify another one (`SolidPrimitive`: BOX_X=0 beside BOX=1 is an index, not a
value). Every value must fit the field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from roboneuron.tools.ros.interfaces.description import FieldChoice, Scalar

HOLDER_WORDS = (
    "type",
    "status",
    "state",
    "mode",
    "level",
    "action",
    "code",
    "kind",
    "result",
    "command",
    "severity",
)
"""Last words of names of fields that contain a choice."""


def assign_choices(
    fields: Sequence[tuple[str, Scalar]], constants: Mapping[str, int]
) -> dict[str, tuple[FieldChoice, ...]]:
    """Return the choices by field name.

    Args:
        fields: the message's single integer fields, in order.
        constants: its integer constants, in order.
    """
    ranges = {name: (scalar.lower or 0, scalar.upper or 0) for name, scalar in fields}
    groups: dict[str, list[str]] = {}
    rest: list[str] = []
    for constant in constants:
        owner = _owner_by_prefix(constant, list(ranges))
        if owner is None:
            rest.append(constant)
        else:
            groups.setdefault(owner, []).append(constant)
    free = [name for name in ranges if name not in groups]
    plain = [c for c in rest if not any(c != other and c.startswith(other + "_") for other in rest)]
    for owner, names in _place(rest, free, constants) or _place(plain, free, constants):
        groups[owner] = names
    return {
        owner: tuple(FieldChoice(name=name, value=constants[name]) for name in names)
        for owner, names in groups.items()
        if all(ranges[owner][0] <= constants[name] <= ranges[owner][1] for name in names)
    }


def _owner_by_prefix(constant: str, fields: Sequence[str]) -> str | None:
    best: tuple[int, str] | None = None
    tied = False
    for field in fields:
        words = field.upper().split("_")
        length = next((len(w) for w in _endings(words) if constant.startswith(w + "_")), 0)
        if length and (best is None or length >= best[0]):
            tied = best is not None and length == best[0]
            best = (length, field)
    return None if best is None or tied else best[1]


def _endings(words: Sequence[str]) -> list[str]:
    """All suffixes of a field's name, longest first."""
    return ["_".join(words[i:]) for i in range(len(words))]


def _place(
    values: Sequence[str], free: Sequence[str], constants: Mapping[str, int]
) -> list[tuple[str, list[str]]]:
    if not values or not free:
        return []
    holders = (
        [name for name in free if name.endswith(HOLDER_WORDS)] if len(free) > 1 else list(free)
    )
    if len(holders) == 1:
        return (
            [(holders[0], list(values))]
            if len({constants[v] for v in values}) == len(values)
            else []
        )
    runs: list[list[str]] = []
    for name in values:
        if runs and constants[name] >= constants[runs[-1][-1]]:
            runs[-1].append(name)
        else:
            runs.append([name])
    return list(zip(holders, runs, strict=True)) if len(runs) == len(holders) else []
