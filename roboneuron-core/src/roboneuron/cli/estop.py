"""Stop all motion of every server and module that uses this state directory; works without any of them.

The stop is latched in a file that every module looks at 50 times a second, and that outlives them all. An agent or
`roboneuron estop --reset` releases it; both are audited.
"""

from __future__ import annotations

import getpass
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron estop`."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="a roboneuron.toml that names the state directory")
    parser.add_argument("--state", type=Path, metavar="DIRECTORY", help="the state directory itself")
    parser.add_argument("--reason", default="", help="why; kept in the latch and in the audit")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--reset", action="store_true", help="release it; look at the robot first")
    action.add_argument("--status", action="store_true", help="only say whether it is latched (exit status 1 if it is)")


def run(arguments: Namespace) -> int:
    """Run `roboneuron estop`."""
    from roboneuron.config import load_config
    from roboneuron.gate.audit import FILE_NAME as AUDIT_NAME
    from roboneuron.gate.audit import AuditLog, AuditRecord
    from roboneuron.gate.estop import FILE_NAME, EmergencyStopLatch
    from roboneuron.gate.request import ADMIN
    from roboneuron.ros.environment import state_directory

    configured = load_config(arguments.config).supervisor.state_directory if arguments.config else None
    directory = state_directory(str(arguments.state) if arguments.state else configured)
    latch = EmergencyStopLatch(directory / FILE_NAME, time.time_ns)
    audit = AuditLog(directory / AUDIT_NAME, time.time_ns)
    who = f"{getpass.getuser()} at the command line"
    if arguments.status:
        state = latch.read_state()
        cause = f" by {state.who}: {state.reason}" if state.who else ""
        print(f"The emergency stop is {f'latched{cause}' if state.latched else 'not latched'} ({latch.path}).")
        return int(state.latched)
    if arguments.reset:
        latch.reset(who=who, role=ADMIN, audit=audit)
        print(f"Released: {latch.path} is gone. A backend that still has an instruction goes on with it.")
        return 0
    latch.latch(who=who, reason=arguments.reason)
    print(f"Emergency stop latched: {latch.path}")
    audit.write(AuditRecord(who=who, role="", tool="estop", verdict="latched", reason=arguments.reason))
    return 0
