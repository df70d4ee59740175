"""Each role includes lower ones, and an unknown role has no rights."""

from __future__ import annotations

import pytest

from roboneuron.gate.roles import Role


@pytest.mark.parametrize(
    ("held", "includes"),
    [
        ("viewer", [Role.VIEWER]),
        (Role.OPERATOR, [Role.VIEWER, Role.OPERATOR]),
        ("admin", [Role.VIEWER, Role.OPERATOR, Role.ADMIN]),
        ("", []),
        ("Admin", []),
    ],
)
def test_a_role_is_held_by_itself_and_by_greater_ones(held: str, includes: list[Role]) -> None:
    assert [role for role in Role if role.is_held_by(held)] == includes
