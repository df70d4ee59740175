"""The gate that everything passes before it moves a robot: allow list, limits, rates, emergency stop, audit."""

# fmt: off
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.estop import EmergencyStopLatch, LatchState
from roboneuron.gate.gate import Gate
from roboneuron.gate.limits import check_endpoint
from roboneuron.gate.request import ADMIN, OPERATOR, ROLES, VIEWER, AllowedEndpoint, Clamp, GateRequest, Verdict

__all__ = [
    "ADMIN", "OPERATOR", "ROLES", "VIEWER", "AllowedEndpoint", "AuditLog", "AuditRecord", "Clamp",
    "EmergencyStopLatch", "Gate", "GateRequest", "LatchState", "Verdict", "check_endpoint",
]
