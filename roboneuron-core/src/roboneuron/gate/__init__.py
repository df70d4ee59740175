"""What keeps a robot safe whoever moves it: limits of motion, roles, audit."""

from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.roles import ADMIN, OPERATOR, ROLES, VIEWER

__all__ = [
    "ADMIN",
    "OPERATOR",
    "ROLES",
    "VIEWER",
    "AuditLog",
    "AuditRecord",
]
