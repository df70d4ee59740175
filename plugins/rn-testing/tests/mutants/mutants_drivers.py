"""Drivers with one mistake each."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
    compute,
    counted,
    forever,
    leave_thread,
    mutants_of,
    mutate,
    or_else,
    read_file,
    remembered,
    then,
)

from rn_testing.fakes import FakeDriver
from roboneuron.contract import JointSample, RobotState
from roboneuron.plugins.specs import DriverSpec

NS = 1_000_000_000
but = mutants_of("driver", FakeDriver)


def measured(**changes):
    """`read` with changed joints."""

    def read(self, call):
        state = call()
        return replace(
            state,
            joints=replace(
                state.joints, **{n: change(self, state.joints) for n, change in changes.items()}
            ),
        )

    return read


def opened(change):
    def read(self, call):
        state = call()
        return replace(state, gripper_open=change(state.gripper_open))

    return read


def clipped(self, call, command):
    names, limits = self._profile.arm_joints, self._profile.limits
    if (
        command.names != names
        or not np.isfinite(command.position).all()
        or not command.duration_s > 0
    ):
        return call(command)
    call(replace(command, position=np.clip(command.position, limits.lower, limits.upper)))
    return command


def past_lower_limit(self, call, command):
    limits = self._profile.limits
    if len(command.position) == 6 and (command.position < limits.lower).any():
        return command
    return call(command)


def jumps(self, call, command):
    sent = call(command)
    self._duration_s = 0.0
    return sent


def at_full_speed(self, call, command):
    sent = call(command)
    self._duration_s = min(
        self._duration_s, max(abs(self._goal[n] - self._start[n]) for n in self._goal) + 1e-6
    )
    return sent


def duration_not_told(self, call, command):
    return replace(call(command), duration_s=command.duration_s)


def velocity_ignored(self, call, command):
    call(command)
    self._duration_s = command.duration_s
    return command


def in_profile_order(self, call, command):
    good = set(command.names) == set(self._profile.arm_joints)
    return call(replace(command, names=self._profile.arm_joints) if good else command)


def blocks(self, call, command):
    sent = call(command)
    time.sleep(0.4)
    return sent


def takes(self, call, command):
    """Sends any command."""
    return or_else(lambda: call(command), lambda: command) if self._start else call(command)


def moves_before_it_refuses(self, call, command):
    if self._start and len(command.position) == 6:
        self._start = {n: p + 0.02 for n, p in self._positions().items()}
        self._goal = dict(self._start)
    return call(command)


def queue(self, call, command):
    if self._start and time.monotonic() < self._begun_s + self._duration_s:
        return command
    return call(command)


def coasts(self, call):
    call()
    goal = {n: p + 0.2 for n, p in self._start.items()}
    self._move(self._start, goal, 1.0)


def to_the_goal(self, call):
    goal = dict(self._goal)
    call()
    self._move(goal, goal, 0.0)


def home(self, call):
    call()
    here = dict(zip(self._profile.arm_joints, self._profile.limits.upper.tolist(), strict=True))
    self._move(here | {"finger": 0.04}, here | {"finger": 0.04}, 0.0)


def latched(self, call, command):
    return command if getattr(self, "held", False) and len(command.position) == 6 else call(command)


def no_gripper(self, call, command):
    sent = call(command)
    if self._start and "finger" in command.names:
        self._goal["finger"] = self._start["finger"]
    return sent


def no_state(self, call):
    call()
    return RobotState(joints=JointSample(names=(), position=np.zeros(0)), gripper_open=1.0)


def back_and_forth(self, joints):
    return joints.stamp_ns - (NS // 2) * (counted(self) % 2)


NAMES = ("__init__", "open", "read", "send", "close")
DRIVERS: dict[str, Mutant] = {
    "no_hold": Mutant(
        rule="driver/protocol", target=mutate(object, **{n: lambda *_: None for n in NAMES})
    ),
    "constructor_reads_a_file": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), read_file())
    ),
    "constructor_starts_a_thread": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), leave_thread())
    ),
    "constructor_computes": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), compute())
    ),
    "constructor_advertises": but(
        "constructor-leaves-topics",
        __init__=lambda s, call, c, p, t: then(call(c, p, t), t.advertise("a", object)),
    ),
    "constructor_opens": but(
        "read-before-open-refused", __init__=lambda s, call, *a: then(call(*a), s.open())
    ),
    "options_ignored": but(
        "options-read",
        spec={"config": "rn_testing.fakes.robot:FakeDriverOptions"},
        __init__=lambda s, call, c, p, t: call(None, p, t),
    ),
    "close_needs_open": but(
        "close-before-open", close=lambda s, call: then(s._positions(), call())
    ),
    "close_takes_20_s": but(
        "close-releases", "close did not return", case={"limits_s": {"close": 0.3}}, close=forever
    ),
    "close_leaves_a_thread": but(
        "close-releases", open=lambda s, call: then(call(), leave_thread())
    ),
    "second_open_starts_another_thread": but(
        "second-open-safe",
        open=lambda s, call: then(call(), leave_thread() if counted(s) > 1 else 0),
    ),
    "open_after_close_is_half": but(
        "open-after-close", open=lambda s, call: call() if counted(s) < 2 else None
    ),
    "open_hangs": but(
        "reads-state", "open did not return", case={"limits_s": {"open": 0.3}}, open=forever
    ),
    "every_state_is_kept": but("memory-bounded", read=lambda s, call: remembered(s, call())),
    "reads_before_open": but(
        "read-before-open-refused",
        read=lambda s, call: then(None if s._start else s.open(), call()),
    ),
    "reads_after_close": but("read-after-close-refused", close=lambda s, call: None),
    "sends_before_open": but(
        "send-before-open-refused", send=lambda s, call, c: or_else(lambda: call(c), lambda: c)
    ),
    "sends_after_close": but("send-after-close-refused", close=lambda s, call: None),
    "holds_after_close": but("hold-after-close-refused", close=lambda s, call: None),
    "holds_before_open_in_silence": but(
        "hold-before-open-refused", hold=lambda s, call: or_else(call, lambda: None)
    ),
    "read_hangs": but(
        "reads-state", "read did not return", case={"limits_s": {"read": 0.3}}, read=forever
    ),
    "read_waits": but("read-quick", read=lambda s, call: then(time.sleep(0.03), call())),
    "read_returns_a_dictionary": but("reads-state", read=lambda s, call: then(call(), {})),
    "read_lacks_a_joint": but(
        "reads-state",
        read=measured(
            names=lambda s, j: j.names[1:],
            position=lambda s, j: j.position[1:],
            velocity=lambda s, j: None,
        ),
    ),
    "read_never_has_a_state": but("reads-state", case={"settle_s": 0.2}, read=no_state),
    "read_in_degrees": but(
        "reads-state", "degrees", read=measured(position=lambda s, j: np.degrees(j.position))
    ),
    "read_in_millimetres": but(
        "reads-state", read=measured(position=lambda s, j: j.position * 1000)
    ),
    "position_of_nan": but(
        "reads-state", read=measured(position=lambda s, j: np.append(j.position[:-1], np.nan))
    ),
    "velocity_of_nan": but(
        "reads-state", "velocity", read=measured(velocity=lambda s, j: j.velocity * np.nan)
    ),
    "velocity_of_two_joints": but(
        "reads-state", read=measured(velocity=lambda s, j: j.velocity[:2])
    ),
    "joint_twice": but(
        "reads-state", read=measured(names=lambda s, j: (*j.names[:-1], j.names[0]))
    ),
    "gripper_not_measured": but("reads-state", read=opened(lambda opening: None)),
    "gripper_not_scaled": but("reads-state", read=opened(lambda opening: opening * 40)),
    "gripper_inverted": but("gripper-follows", read=opened(lambda opening: 1 - opening)),
    "gripper_ignored": but("gripper-follows", case={"settle_s": 0.3}, send=no_gripper),
    "stamp_zero": but("stamps-in-ros-time", read=measured(stamp_ns=lambda s, j: 0)),
    "stamp_in_seconds": but(
        "stamps-in-ros-time", read=measured(stamp_ns=lambda s, j: j.stamp_ns // NS)
    ),
    "stamp_monotonic": but(
        "stamps-in-ros-time", read=measured(stamp_ns=lambda s, j: time.monotonic_ns())
    ),
    "stamp_of_the_wall_clock": but(
        "stamps-in-ros-time", read=measured(stamp_ns=lambda s, j: time.time_ns())
    ),
    "stamp_in_the_future": but(
        "stamps-in-ros-time", "future", read=measured(stamp_ns=lambda s, j: j.stamp_ns + NS)
    ),
    "stamps_go_back": but("stamps-in-ros-time", read=measured(stamp_ns=back_and_forth)),
    "stamp_stays": but(
        "stamps-in-ros-time",
        "same",
        read=measured(stamp_ns=lambda s, j: s.__dict__.setdefault("first", j.stamp_ns)),
    ),
    "send_returns_nothing": but("send-arrives", send=lambda s, call, c: then(call(c), None)),
    "send_does_nothing": but("send-arrives", case={"settle_s": 0.2}, send=lambda s, call, c: c),
    "send_goes_halfway": but(
        "send-arrives",
        case={"settle_s": 0.2},
        send=lambda s, call, c: then(
            call(
                replace(c, position=(c.position + np.array(list(s._positions().values()))[:6]) / 2)
            ),
            c,
        ),
    ),
    "send_moves_another_joint": but(
        "send-arrives",
        case={"settle_s": 0.2},
        send=lambda s, call, c: then(call(replace(c, position=np.roll(c.position, 1))), c),
    ),
    "send_moves_by_the_position": but(
        "send-arrives",
        case={"settle_s": 0.2},
        send=lambda s, call, c: then(call(replace(c, position=c.position + 0.1)), c),
    ),
    "send_changes_the_goal": but(
        "send-arrives", send=lambda s, call, c: call(replace(c, position=c.position * 0.9))
    ),
    "send_hangs": but(
        "send-arrives", "send did not return", case={"limits_s": {"send": 0.3}}, send=forever
    ),
    "send_waits_for_the_end": but("send-quick", send=blocks),
    "joints_in_the_order_of_the_profile": but(
        "joints-by-name", case={"settle_s": 0.2}, send=in_profile_order
    ),
    "jumps_whatever_the_duration": but("duration-kept", send=jumps),
    "moves_at_full_speed": but("duration-kept", send=at_full_speed),
    "told_another_duration": but(
        "duration-kept", send=lambda s, call, c: replace(call(c), duration_s=c.duration_s / 10)
    ),
    "sent_duration_not_told": but("velocity-kept", send=duration_not_told),
    "velocity_limits_ignored": but("velocity-kept", send=velocity_ignored),
    "jumps_when_told_to_hurry": but("velocity-kept", send=jumps),
    "takes_anything": but("bad-command-refused", send=takes),
    "takes_no_duration": but(
        "bad-command-refused",
        "duration",
        send=lambda s, call, c: call(c if c.duration_s > 0 else replace(c, duration_s=1.0)),
    ),
    "nan_is_zero": but(
        "bad-command-refused",
        "NaN",
        send=lambda s, call, c: call(replace(c, position=np.nan_to_num(c.position, posinf=0))),
    ),
    "unknown_joint_crashes": but(
        "bad-command-refused",
        "KeyError",
        send=lambda s, call, c: then([s._start[n] for n in c.names], call(c)),
    ),
    "moves_before_it_refuses": but("bad-command-refused", "moved", send=moves_before_it_refuses),
    "limits_ignored": but("limits-kept", send=takes),
    "limits_clamped_in_silence": but("limits-kept", send=clipped),
    "only_upper_limits": but("limits-kept", send=past_lower_limit),
    "commands_are_queued": but("newest-command-wins", case={"settle_s": 0.3}, send=queue),
    "hold_coasts_on": but("hold-stops", hold=coasts),
    "hold_does_nothing": but("hold-stops", hold=lambda s, call: None),
    "hold_jumps_to_the_goal": but("hold-stops", "hold() moved", hold=to_the_goal),
    "hold_drives_home": but("hold-stops", "hold() moved", hold=home),
    "hold_hangs": but(
        "hold-stops", "hold did not return", case={"limits_s": {"hold": 0.3}}, hold=forever
    ),
    "hold_for_ever": but(
        "moves-after-hold",
        case={"settle_s": 0.2},
        hold=lambda s, call: then(call(), setattr(s, "held", True)),
        send=latched,
    ),
}

DRIVERS["target_absent"] = Mutant(
    rule="driver/target-callable",
    spec={
        "drivers": (
            DriverSpec(name="simulated", summary="Absent.", target="mutants_drivers:absent"),
        )
    },
)

# the prefix distinguishes them from the functions above
MUTANTS = {f"driver_{n}": m for n, m in DRIVERS.items()}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
