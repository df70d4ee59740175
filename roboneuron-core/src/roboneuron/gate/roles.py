"""Roles of those who call tools.

A role belongs to a client, by the transport that it came over or by its token; core only compares
roles.
"""

VIEWER, OPERATOR, ADMIN = "viewer", "operator", "admin"
ROLES = (VIEWER, OPERATOR, ADMIN)
"""Roles from least to most: read; also move; also expose and reset. Each includes the ones before
it.
"""


def has_role(role: str, least: str) -> bool:
    """Whether `role` is at least `least`; an unknown role has no rights."""
    return role in ROLES and ROLES.index(role) >= ROLES.index(least)
