"""Stop all motion of every server and module that uses this state directory, without needing any of
them.

The stop is latched in a file, which every module checks 50 times a second; each of several robots
has its own. A person releases it in a terminal with `roboneuron estop --reset`.
"""

from __future__ import annotations

import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path

from roboneuron.cli.state_folder import add_arguments, folders_of
from roboneuron.cli.terminal import ask_hidden, is_agreed
from roboneuron.errors import RefusedError, RoboNeuronError
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog, AuditRecord, Role

_AGAIN_S = 0.1
"""Time within which a process that keeps the stop on the topic latches it again after a release."""


def configure(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron estop`."""
    add_arguments(parser)
    parser.add_argument("--reason", default="", help="why; kept in the latch and in the audit")
    action = parser.add_mutually_exclusive_group()
    action.add_argument("--reset", action="store_true", help="release it; look at the robot first")
    action.add_argument(
        "--set-pin",
        action="store_true",
        help="have a release ask for a PIN; an empty one removes it",
    )
    action.add_argument(
        "--status",
        action="store_true",
        help="only say whether it is latched (exit status 1 if it is)",
    )


def run(arguments: Namespace) -> int:
    """Run `roboneuron estop`.

    Raises:
        ConfigurationError: the robot is unknown, or the file names no state directory.
        RoboNeuronError: one stop could not be latched; the others are.
    """
    first = folders_of(arguments)[0]
    who = AuditLog.user_at_terminal()
    if arguments.set_pin:
        return _set_pin(ReleasePin(first), AuditLog.in_directory(first), who)
    done: set[Path] = set()
    status, failure = 0, None
    # repeated, because a server that starts meanwhile creates more folders
    while folders := set(folders_of(arguments)) - done:
        for folder in sorted(folders):
            latch = EmergencyStopLatch.in_directory(folder)
            audit = AuditLog.in_directory(folder)
            if arguments.status:
                status |= _show(latch)
            elif arguments.reset:
                status |= _reset(latch, audit, who)
            else:
                try:
                    _press(latch, audit, who, arguments.reason)
                except RoboNeuronError as error:  # the others are stopped all the same
                    failure = error
        done |= folders
    if failure is not None:
        raise failure
    return status


def _show(latch: EmergencyStopLatch) -> int:
    """Print whether it is latched, and by whom; return the exit status."""
    state = latch.read_state()
    cause = f" by {state.cause}" if state.cause else ""
    word = f"latched{cause}" if state.latched else "not latched"
    print(f"The emergency stop is {word} ({latch.path}).")
    return int(state.latched)


def _press(latch: EmergencyStopLatch, audit: AuditLog, who: str, reason: str) -> None:
    """Latch, print and record it; in this order, because a stop must not wait for a disk.

    Raises:
        UnsafeError: the latch cannot be written.
        RefusedError: it is latched, but the audit cannot be written.
    """
    latch.latch(who=who, reason=reason)
    print(f"Emergency stop latched: {latch.path}")
    audit.write(AuditRecord(who=who, role="", tool="estop", verdict="latched", reason=reason))


def _reset(latch: EmergencyStopLatch, audit: AuditLog, who: str) -> int:
    """Ask the person at the terminal for confirmation, then release.

    Raises:
        RefusedError: there is no terminal for the question, or the audit cannot be written.
    """
    state = latch.read_state()
    if not state.latched:
        print(f"The emergency stop is not latched ({latch.path}).")
        return 0
    _check_terminal("The emergency stop is released")
    print(f"Latched{f' by {state.cause}' if state.cause else ''} ({latch.path}).")
    if state.reason:
        print("The words in quotation marks are theirs, a person's or an agent's.")
    print(
        "Look at the robot. Nothing moves until someone gives a new instruction or moves the arm."
    )
    if not is_agreed("Release the emergency stop?"):
        print("It stays latched.")
        return 1
    pin = ask_hidden("PIN: ") if ReleasePin(latch.path.parent).is_set else ""
    latch.reset(who=who, role=Role.ADMIN, audit=audit, pin=pin, agreed_ns=state.time_ns)
    time.sleep(_AGAIN_S)  # a process that latches it again does so within one check of the file
    if latch.is_latched():
        print(
            f"It was latched again at once by {latch.read_state().cause or 'somebody'}.",
            file=sys.stderr,
        )
        return 1
    print("Released.")
    return 0


def _check_terminal(what: str) -> None:
    """Raise RefusedError without a terminal for a question."""
    if not sys.stdin.isatty():
        raise RefusedError(
            f"{what} only by a person in a terminal, and this is no terminal.",
            hint="Run the same command in a terminal (over ssh: `ssh -t`).",
            rule="person",
        )


def _set_pin(pin: ReleasePin, audit: AuditLog, who: str) -> int:
    """Ask for the present PIN, and twice for the new one.

    Raises:
        RefusedError: there is no terminal, or the present PIN is wrong.
        InvalidInputError: the new one is too short or too long.
    """
    _check_terminal("The PIN is set")
    if pin.is_set:
        pin.check(ask_hidden("Present PIN: "), who=who, audit=audit)
    new = ask_hidden("New PIN (empty for none): ")
    if ask_hidden("Again: ") != new:
        print("They differ; nothing was changed.", file=sys.stderr)
        return 1
    audit.write(
        AuditRecord(
            who=who, role="", tool="set_pin", verdict="allowed", reason="" if new else "removed"
        )
    )
    pin.set(new)
    print(
        f"A release of the emergency stop asks for {'the PIN' if new else 'no PIN'} from now on "
        f"({pin.path})."
    )
    return 0
