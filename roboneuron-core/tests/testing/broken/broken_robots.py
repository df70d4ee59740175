"""Profiles and drivers with one fault each."""

import threading
import time
from dataclasses import replace

import numpy as np

from roboneuron.contract import Workspace
from roboneuron.errors import StateError
from roboneuron.testing.fakes import FakeDriver, gantry_profile


def no_profile():
    return {"name": "gantry"}


def other_name():
    return replace(gantry_profile(), name="other")


def crossed_limits():
    profile = gantry_profile()
    return replace(profile, limits=replace(profile.limits, lower=profile.limits.upper))


def short_limits():
    profile = gantry_profile()
    return replace(profile, limits=replace(profile.limits, velocity=np.ones(2)))


def far_home():
    return replace(gantry_profile(), home_rad=np.full(6, 50.0))


def torn_urdf():
    return replace(gantry_profile(), urdf="<robot>")


def wrong_tcp():
    return replace(gantry_profile(), tcp_link="tool")


def stray_joint():
    profile = gantry_profile()
    return replace(profile, arm_joints=("elbow", *profile.arm_joints[1:]))


def one_camera():
    profile = gantry_profile()
    return replace(profile, cameras=profile.cameras[:1])


def stuck_gripper():
    profile = gantry_profile()
    return replace(profile, gripper=replace(profile.gripper, open_position=0.0))


def empty_workspace():
    return replace(gantry_profile(), workspace=Workspace(lower_m=np.ones(3), upper_m=np.zeros(3)))


def wrong_endpoint():
    profile = gantry_profile()
    return replace(profile, endpoints=(replace(profile.endpoints[0], type="sensor_msgs/srv/JointState"),))


class NoHold:
    def __init__(self, config, profile, topics): ...
    def open(self): ...
    def read(self): ...
    def send(self, command): ...
    def close(self): ...


class OpensFile(FakeDriver):
    def __init__(self, config, profile, topics):
        super().__init__(config, profile, topics)
        open("/proc/self/status", "rb").close()


class CloseNeedsOpen(FakeDriver):
    def close(self):
        self._opened()
        super().close()


class LacksJoint(FakeDriver):
    def read(self):
        state = super().read()
        joints = replace(state.joints, names=state.joints.names[1:], position=state.joints.position[1:], velocity=None)
        return replace(state, joints=joints)


class ReadsSlowly(FakeDriver):
    def read(self):
        time.sleep(0.03)
        return super().read()


class ReadsUnopened(FakeDriver):
    def __init__(self, config, profile, topics):
        super().__init__(config, profile, topics)
        FakeDriver.open(self)


class StaysPut(FakeDriver):
    def send(self, command):
        before = dict(self._opened())
        sent = super().send(command)
        self._positions.update(before)
        return sent


class TakesAnything(FakeDriver):
    def send(self, command):
        return command


class ExceedsLimits(FakeDriver):
    def send(self, command):
        self._opened().update(zip(command.names, command.position.tolist(), strict=True))
        return command


class CoastsOn(FakeDriver):
    def hold(self):
        self._opened()
        self._coasting = time.monotonic()

    def read(self):
        if hasattr(self, "_coasting"):
            self._opened()["roll"] = 0.1 * (time.monotonic() - self._coasting)
        return super().read()


class LeavesThread(FakeDriver):
    def open(self):
        super().open()
        threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()


class NeverReads(FakeDriver):
    def read(self):
        raise StateError("never")
