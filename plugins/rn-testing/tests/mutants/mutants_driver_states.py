"""Drivers that move what a command does not name, or whose states change."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from mutation import Mutant, mutants_of

from rn_testing.fakes import FakeDriver
from roboneuron.contract import JointCommand

but = mutants_of("driver", FakeDriver)


def unnamed_to(value):
    """`send` that sends joints without a position to `value`."""

    def send(self, call, command):
        unnamed = [n for n in self._profile.arm_joints if n not in command.names]
        if not self._start or not unnamed or len(command.position) != len(command.names):
            return call(command)
        position = np.append(command.position, [value] * len(unnamed))
        call(replace(command, names=(*command.names, *unnamed), position=position))
        return command

    return send


def unnamed_to_the_last_goal(self, call, command):
    """Sends joints that are not named to where they were sent last, also if `hold` came since."""
    last = getattr(self, "last", {})
    self.last = {**last, **dict(zip(command.names, command.position.tolist(), strict=False))}
    if not self._start or len(command.position) != len(command.names):
        return call(command)
    first = {n: p + 0.05 for n, p in last.items() if n not in command.names and n != "finger"}
    position = np.append(command.position, list(first.values()))
    call(replace(command, names=(*command.names, *first), position=position))
    return command


def gripper_closes_unnamed(self, call, command):
    if not self._start or "finger" in command.names or len(command.position) != len(command.names):
        return call(command)
    more = replace(
        command, names=(*command.names, "finger"), position=np.append(command.position, 0.0)
    )
    call(more)
    return command


def shared_state(self, call):
    """All states share one array, which the next `read` overwrites."""
    state = call()
    self.shared = getattr(self, "shared", np.zeros(len(state.joints.position)))
    self.shared[:] = state.joints.position
    joints = replace(state.joints)
    object.__setattr__(joints, "position", self.shared)
    return replace(state, joints=joints)


def opens_on_hold(self, call):
    call()
    here = {**self._positions(), "finger": 0.04}
    self._move(here, here, 0.0)


def goes_home(self, call):
    """Goes home first, if it is open."""
    if self._start is not None:
        home = self._profile.home_rad
        self.send(
            JointCommand(names=self._profile.arm_joints, position=home.copy(), duration_s=2.0)
        )
    call()


def goes_home_by_itself(self, call):
    """Moves for a moment before it is closed, without a command of its own."""
    if self._start:
        self._move(self._positions(), dict.fromkeys(self._start, 0.0), 0.2)
        time.sleep(0.25)
    call()


def returns_by_itself(self, call):
    """Moves back to where it was opened before it is closed, without a command of its own."""
    if self._start:
        home = dict(zip(self._profile.arm_joints, self._profile.home_rad.tolist(), strict=True))
        self._move(self._positions(), self._positions() | home, 0.2)
        time.sleep(0.25)
    call()


MUTANTS: dict[str, Mutant] = {
    "driver_returns_on_close": but("close-stands-still", close=returns_by_itself),
    "driver_goes_home_on_close": but("close-stands-still", close=goes_home_by_itself),
    "driver_goes_home_when_it_is_closed": but("close-stands-still", close=goes_home),
    "driver_states_share_an_array": but("state-kept", read=shared_state),
    "driver_hold_opens_the_gripper": but("hold-stops", "gripper", hold=opens_on_hold),
    "driver_unnamed_joints_to_zero": but(
        "unnamed-joints-stay", "another joint", send=unnamed_to(0.0)
    ),
    "driver_unnamed_joints_to_a_limit": but("unnamed-joints-stay", send=unnamed_to(1.0)),
    "driver_unnamed_joints_beyond_their_last_goal": but(
        "unnamed-joints-stay", send=unnamed_to_the_last_goal
    ),
    "driver_unnamed_gripper_closes": but(
        "unnamed-joints-stay", "gripper", send=gripper_closes_unnamed
    ),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
