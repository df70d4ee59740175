"""A scripted leader arm: publishes joint states for `lerobot-record` and `-teleoperate`.

    python examples/scripted_leader.py --robot so101

It starts at the robot's measured position and oscillates around it, reproducibly, instead of a
person with a leader arm. Ctrl-C ends it.
"""

from __future__ import annotations

import argparse
import math
import sys
import time

from roboneuron.command import RosLink, discover, environment
from roboneuron.feature import load_profile

PERIOD_S, STEP_S = 4.0, 1.0 / 50.0
SWAY_RAD = (0.25, 0.08, -0.08, 0.0, 0.3, 0.1, 0.2)
"""Amplitude of each joint."""


def main() -> int:
    """Publish until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="so101")
    parser.add_argument("--namespace", default="", help="default: the robot's name")
    parser.add_argument("--topic", default="/leader/joint_states")
    chosen = parser.parse_args()
    environment.prepare_environment()
    from sensor_msgs.msg import JointState

    profile = load_profile(discover(), chosen.robot)
    namespace = chosen.namespace or chosen.robot.replace("-", "_")
    link, seen = RosLink("scripted_leader"), list[JointState]()
    link.open()
    link.subscribe(JointState, f"/{namespace}/joint_states", seen.append)
    publish = link.advertise(JointState, chosen.topic)
    while not seen:
        time.sleep(STEP_S)
    start = dict(zip(seen[-1].name, seen[-1].position, strict=True))
    print("leading", flush=True)
    begun_s = time.monotonic()
    try:
        while True:
            phase = 2.0 * math.pi * (time.monotonic() - begun_s) / PERIOD_S
            positions = dict(start)
            for arm in profile.each_arm:
                for joint, sway in zip(arm.joints, SWAY_RAD, strict=False):
                    positions[joint] += sway * math.sin(phase)
            for gripper in profile.grippers:
                opening = 0.7 + 0.3 * math.cos(phase)
                positions[gripper.joint] = gripper.to_position(opening)
            publish(JointState(name=list(positions), position=list(positions.values())))
            del seen[:-1]
            time.sleep(STEP_S)
    except KeyboardInterrupt:
        return 0
    finally:
        link.close()


if __name__ == "__main__":
    sys.exit(main())
