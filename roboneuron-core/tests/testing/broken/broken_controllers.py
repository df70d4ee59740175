"""Controllers with one fault each."""

import threading
import time
from dataclasses import replace

import numpy as np

from roboneuron.contract import Hold, JointCommand
from roboneuron.errors import StateError
from roboneuron.testing.fakes import GantryController


class NoForward:
    def __init__(self, config, profile): ...
    def load(self): ...
    def compute(self, action, joints, step_s): ...
    def close(self): ...


class OpensFile(GantryController):
    def __init__(self, config, profile):
        super().__init__(config, profile)
        open("/proc/self/status", "rb").close()


class CloseNeedsLoad(GantryController):
    def close(self):
        if not self._loaded:
            raise StateError("not loaded")
        super().close()


class LeavesThread(GantryController):
    def load(self):
        super().load()
        threading.Thread(target=time.sleep, args=(7,), name="forgotten", daemon=True).start()


class ComputesUnloaded(GantryController):
    def compute(self, action, joints, step_s):
        return Hold(code="not_loaded", reason="not loaded")


class LongQuaternion(GantryController):
    def forward(self, joints):
        pose = super().forward(joints)
        return replace(pose, quaternion_xyzw=2 * pose.quaternion_xyzw)


class ForwardAccepts(GantryController):
    def forward(self, joints):
        position = np.nan_to_num(np.resize(joints.position, 6))
        return super().forward(replace(joints, names=self._profile.arm_joints, position=position, velocity=None))


class StopsShort(GantryController):
    def compute(self, action, joints, step_s):
        command = super().compute(action, joints, step_s)
        if isinstance(command, Hold):
            return command
        measured = dict(zip(joints.names, joints.position, strict=True))
        half = [(p + measured[n]) / 2 for n, p in zip(command.names, command.position, strict=True)]
        return replace(command, position=np.array(half))


class RefusesAll(GantryController):
    def compute(self, action, joints, step_s):
        super().compute(action, joints, step_s)
        return Hold(code="shy", reason="I would rather not.")


class Drifts(GantryController):
    def compute(self, action, joints, step_s):
        command = super().compute(action, joints, step_s)
        if isinstance(command, Hold) or action.to_vector()[:6].any():
            return command
        return replace(command, position=command.position + 0.01)


class MovesBlindly(GantryController):
    def compute(self, action, joints, step_s):
        result = super().compute(action, joints, step_s)
        if isinstance(result, Hold) and result.code == "bad_state":
            return JointCommand(names=self._profile.arm_joints, position=np.zeros(6), duration_s=step_s)
        return result


class HoldsSilently(GantryController):
    def compute(self, action, joints, step_s):
        result = super().compute(action, joints, step_s)
        return Hold(code="", reason="") if isinstance(result, Hold) else result


class Jumps(GantryController):
    def compute(self, action, joints, step_s):
        result = super().compute(action, joints, step_s)
        if isinstance(result, Hold) and result.code == "joint_jump":
            position = np.asarray(self._profile.limits.upper)
            return JointCommand(names=self._profile.arm_joints, position=position, duration_s=step_s)
        return result


class LeavesLimits(GantryController):
    def compute(self, action, joints, step_s):
        result = super().compute(action, joints, step_s)
        if isinstance(result, Hold) and result.code == "joint_jump":
            return JointCommand(names=self._profile.arm_joints, position=np.full(6, 9.0), duration_s=step_s)
        return result


class Remembers(GantryController):
    _offset = 0.0

    def compute(self, action, joints, step_s):
        result = super().compute(action, joints, step_s)
        self._offset += 1e-4
        return result if isinstance(result, Hold) else replace(result, position=result.position + self._offset)
