"""Safety of a robot, whichever client moves it: limits of motion, roles, audit, and why it does
not move.
"""

from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.roles import Role
from roboneuron.gate.stillness import StillReason

__all__ = [
    "AuditLog",
    "AuditRecord",
    "Role",
    "StillReason",
]
