"""Safety of a robot, whichever client moves it: limits of motion, roles, audit."""

from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.roles import Role

__all__ = [
    "AuditLog",
    "AuditRecord",
    "Role",
]
