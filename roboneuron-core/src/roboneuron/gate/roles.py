"""Roles of the clients that call tools.

A role belongs to a client, by its transport or token; core only compares roles.
"""

from enum import StrEnum

from roboneuron.gate.stillness import StillReason


class Role(StrEnum):
    """Roles from least to most: read; also move; also expose and reset. Each includes the previous
    ones.
    """

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"

    def is_held_by(self, role: str) -> bool:
        """Return True if a client with `role` has at least this one; an unknown role has no
        rights.
        """
        return _RANKS.get(role, -1) >= _RANKS[self]

    def check(self, who: str, role: str, what: str) -> None:
        """Raise RefusedError unless the client `who` with `role` may do `what`, which needs at
        least this role.
        """
        # compared here, because every call passes it
        if _RANKS.get(role, -1) < _RANKS[self] and (reason := self.still_reason(who, role, what)):
            raise reason.refusal()

    def still_reason(
        self, who: str, role: str, what: str = "Moving the robot"
    ) -> StillReason | None:
        """Why a client may not do that, see `check`; None if it may."""
        if self.is_held_by(role):
            return None
        return StillReason(
            rank="role",
            rule="role",
            message=f"{what} needs the role '{self}'; {who} has {role or 'none'!r}.",
            hint="Use a token with that role, or ask a person who has one.",
        )


_RANKS: dict[str, int] = {role: rank for rank, role in enumerate(Role)}
