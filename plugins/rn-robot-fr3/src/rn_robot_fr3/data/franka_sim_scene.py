"""franka-sim with a hand, a table and cubes, in the simulator's own environment, where this package
is not installed.

Started by `rn_robot_fr3.fci.simulator`. In addition to the FCI (TCP/UDP 1337, gripper 1338) it
answers on a UDP port: "{}" requests the scene; {"mode": 5} presses the user stop, {"mode": 1}
releases it; {"error": 0..40} stops a motion with that flag; {"drop": n} drops the next n states to
the client. With --record FILE, each physics step appends 15 float64 to it: monotonic time [s],
joints [rad] and their velocities [rad/s]. Each command appends 11 to FILE.commands: monotonic time
[s], number of the answered state, 0 in time or 1 late or 2 missing (the simulator extrapolated),
whether it was accepted, joints [rad]; {"flush": 1} writes the buffer. Facts about franka-sim: its
version 1.1.7, `franka_sim.mujoco_franka_sim`, `franka_sim.limits.checker`.
"""

# mypy: ignore-errors
import argparse
import ctypes
import json
import logging
import pathlib
import signal
import socket
import threading
import time
import types

import franka_sim.mujoco_franka_sim as backend
import mujoco
import numpy as np
from franka_sim import FrankaSimServer
from franka_sim.franka_protocol import MoveStatus, RobotMode
from franka_sim.limits.checker import MotionLimitChecker
from franka_sim.robot_state import RobotState
from franka_sim.server import state_stream

JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
FINGERS = ("fr3_finger_joint1", "fr3_finger_joint2")
ROBOT, SURROUNDINGS = 1, 2
PR_SET_PDEATHSIG = 1
"""Source: linux/prctl.h."""
ARMATURE = 0.195
"""Armature of MuJoCo Menagerie's FR3 [kg m^2]; with less, franka-sim's damping is unstable at 1
ms.
"""
FINGER_ARMATURE_KG = 0.3
IN_TIME, LATE, MISSING = 0, 1, 2
STANDING_MODES = (RobotMode.kOther, RobotMode.kGuiding, RobotMode.kUserStopped)
"""Modes in which the control box starts no motion: brakes closed, guided by hand, user stop."""


def solid(geom, friction, bit):
    """Make a geom collide with everything except the robot."""
    geom.contype, geom.conaffinity = bit, 0 if bit == ROBOT else ROBOT | SURROUNDINGS
    geom.condim = 4
    geom.friction, geom.solref = friction, (0.005, 1.0)
    geom.solimp = (0.98, 0.999, 0.001, 0.5, 2.0)


def build(scene, dt):
    """Compile the model: the robot of our URDF, the table, the cubes."""
    compiler = '<mujoco><compiler discardvisual="true" fusestatic="false"/></mujoco></robot>'
    spec = mujoco.MjSpec.from_string(scene["urdf"].replace("</robot>", compiler))
    for body in spec.bodies:
        body.gravcomp = 1.0
    for geom in spec.geoms:
        solid(geom, scene["finger_friction"], ROBOT)
    for joint in spec.joints:
        joint.armature = FINGER_ARMATURE_KG if joint.name in FINGERS else ARMATURE
    table = spec.worldbody.add_geom()
    table.type, table.size = mujoco.mjtGeom.mjGEOM_BOX, np.array(scene["table_size_m"]) / 2
    table.pos = scene["table_centre_m"]
    solid(table, (scene["table_friction"], 0.005, 0.0001), SURROUNDINGS)
    for cube in scene["cubes"]:
        body = spec.worldbody.add_body()
        body.name, body.pos = cube["name"], (cube["x_m"], cube["y_m"], cube["edge_m"] / 2)
        body.quat = (np.cos(cube["yaw_rad"] / 2), 0.0, 0.0, np.sin(cube["yaw_rad"] / 2))
        joint = body.add_joint()
        joint.type, joint.name = mujoco.mjtJoint.mjJNT_FREE, cube["name"]
        box = body.add_geom()
        box.type, box.size, box.density = (
            mujoco.mjtGeom.mjGEOM_BOX,
            [cube["edge_m"] / 2] * 3,
            scene["density_kg_m3"],
        )
        solid(box, scene["cube_friction"], SURROUNDINGS)
    spec.option.timestep = dt
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    return spec.compile(), "fr3_"


class SceneSim(backend.MujocoFrankaSim):
    """franka-sim's arm and hand in our scene, starting in our home posture."""

    def __init__(self, scene, record=None):
        super().__init__(enable_hand=True)
        self.record = record and open(record, "wb")  # noqa: SIM115 - written to the end
        self.commands = record and open(record + ".commands", "wb")  # noqa: SIM115
        if record:
            record_commands(self.commands)
        self.scene = scene
        self.truth = {}
        self.keep_mode = lambda: None
        backend.ARM_INITIAL_Q = np.array(scene["home_rad"])
        backend.build_model = lambda enable_hand, dt, model_path: build(scene, dt)
        self.latest_joint_positions = backend.ARM_INITIAL_Q.copy()
        self._position_feedforward = backend.PositionFeedforward(backend.ARM_INITIAL_Q)
        backend.default_fr3_mjcf = lambda: pathlib.Path("fr3.urdf of rn-robot-fr3")

    def finger_control_force(self):
        """Like the parent's, with the two fingers coupled as by the single motor of the real
        hand.
        """
        force = super().finger_control_force()
        apart = self.data.qpos[self.finger_qpos_adr[0]] - self.data.qpos[self.finger_qpos_adr[1]]
        speed = self.data.qvel[self.finger_dofs_idx[0]] - self.data.qvel[self.finger_dofs_idx[1]]
        keep = 4000.0 * apart + 60.0 * speed
        return force + np.array([-keep, keep])

    def _read_and_publish_state(self):
        super()._read_and_publish_state()
        self.keep_mode()
        if self.record:
            state = self._state_snapshot
            self.record.write(
                np.concatenate([[time.monotonic()], state["q"], state["dq"]]).tobytes()
            )
        poses = []
        for cube in self.scene["cubes"]:
            start = self.model.joint(cube["name"]).qposadr[0]
            x, y, z, qw, qx, qy, qz = self.data.qpos[start : start + 7].tolist()
            poses.append([x, y, z, qx, qy, qz, qw])
        self.truth = {
            "time_s": self.data.time,
            "seed": self.scene["seed"],
            "joints": [
                *self.data.qpos[self.arm_qpos_adr].tolist(),
                *self.data.qpos[self.finger_qpos_adr].tolist(),
            ],
            "velocities": self.data.qvel[self.arm_dofs_idx].tolist(),
            "cubes": [[cube["name"], cube["edge_m"]] for cube in self.scene["cubes"]],
            "poses": poses,
        }


class LossySocket(socket.socket):
    """Drops as many of the robot's states as requested."""

    to_drop = 0

    def sendto(self, data, address):
        """Like the parent's, unless the datagram is dropped."""
        if LossySocket.to_drop:
            LossySocket.to_drop -= 1
            return len(data)
        return super().sendto(data, address)


def record_commands(file):
    """Record the inputs of the simulator's check of motion limits."""
    absorb, extrapolate = MotionLimitChecker.absorb_command, MotionLimitChecker.extrapolate

    def write(command, kind, accepted):
        file.write(
            np.array(
                [time.monotonic(), command["message_id"], kind, accepted, *command["q_c"]]
            ).tobytes()
        )

    def absorb_command(self, command, joint_positions=None, *, fresh, enforce=False):
        outcome = absorb(self, command, joint_positions, fresh=fresh, enforce=enforce)
        write(command, IN_TIME if fresh else LATE, outcome.accepted)
        return outcome

    def extrapolate_command(self, message_id):
        outcome = extrapolate(self, message_id)
        if outcome is not None:
            write(outcome[0], MISSING, outcome[1] is None)
        return outcome

    MotionLimitChecker.absorb_command, MotionLimitChecker.extrapolate = (
        absorb_command,
        extrapolate_command,
    )


def tell(sim, server, address):
    """Answer requests, and act as the person at the arm."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(address)
    while True:
        data, sender = listener.recvfrom(1024)
        asked = json.loads(data)
        if "mode" in asked:
            mode = RobotMode(asked["mode"])
            if (
                mode != RobotMode.kIdle
                and server.robot_state.state["robot_mode"] == RobotMode.kMove
            ):
                server._abort_with_error(0, f"told to stop: {mode.name}")
                server.robot_state.state["errors"] = [False] * 41
            server.robot_state.state["robot_mode"] = mode
            kept = {"robot_mode": mode} if mode != RobotMode.kIdle else {}
            sim.keep_mode = lambda kept=kept: server.robot_state.state.update(kept)
        if "error" in asked:
            server._abort_with_error(int(asked["error"]), "told to stop")
        LossySocket.to_drop = int(asked.get("drop", LossySocket.to_drop))
        if "flush" in asked and sim.record:
            sim.record.flush()
            sim.commands.flush()
        listener.sendto(json.dumps(sim.truth).encode(), sender)


class ControlBoxServer(FrankaSimServer):
    """Like the parent, but refuses motions as a control box does."""

    def _refuse_move_while_latched(self, client_socket, header):
        """Also refuse while a person has pressed the user stop, guides the arm or closed its
        brakes.
        """
        if self.robot_state.state["robot_mode"] in STANDING_MODES:
            self.send_move_response(
                client_socket, header.command_id, MoveStatus.kCommandNotPossibleRejected
            )
            return True
        return super()._refuse_move_while_latched(client_socket, header)


def begin_motions_at_once():
    """Make a motion's mode visible no later than its generator.

    The state is sent by another thread. With a generator but without kMove, libfranka assumes that
    the motion has ended, and waits for its end without a bound.
    """
    set_generator = RobotState.set_motion_generator_mode

    def set_mode_and_generator(self, mode):
        self.state["robot_mode"] = RobotMode.kMove
        set_generator(self, mode)

    RobotState.set_motion_generator_mode = set_mode_and_generator


def main():
    """Run until interrupted, or until the parent process ends."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    parser = argparse.ArgumentParser()
    parser.add_argument("scene")
    parser.add_argument("--scene-port", type=int, required=True)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--record", default=None)
    parser.add_argument("--no-gripper", action="store_true")
    parser.add_argument("--enforce-comm-constraints", action="store_true")
    parser.add_argument("--enforce-motion-limits", action="store_true")
    arguments = parser.parse_args()
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    begin_motions_at_once()
    state_stream.socket = types.SimpleNamespace(**{**vars(socket), "socket": LossySocket})
    sim = SceneSim(json.loads(pathlib.Path(arguments.scene).read_text()), arguments.record)
    server = ControlBoxServer(
        host=arguments.host,
        physics_sim=sim,
        enable_gripper=not arguments.no_gripper,
        gripper_physics=not arguments.no_gripper,
        enforce_comm_constraints=arguments.enforce_comm_constraints,
        enforce_motion_limits=arguments.enforce_motion_limits,
    )
    threading.Thread(
        target=tell, args=(sim, server, (arguments.host, arguments.scene_port)), daemon=True
    ).start()
    try:
        server.start()
    except KeyboardInterrupt:
        server.stop()


if __name__ == "__main__":
    main()
