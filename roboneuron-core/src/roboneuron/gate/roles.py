"""Roles of the clients that call tools.

A role belongs to a client, by its transport or token; core only compares roles.
"""

from enum import StrEnum


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


_RANKS: dict[str, int] = {role: rank for rank, role in enumerate(Role)}
