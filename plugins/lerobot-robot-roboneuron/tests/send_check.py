"""Runs in lerobot's environment: sends actions to the simulated SO-101 by the robot `roboneuron`,
and prints as JSON the requested actions, the results of `send_action` and the previous positions.
"""

from __future__ import annotations

import json
import time

from lerobot_robot_roboneuron import RoboNeuron, RoboNeuronConfig

from roboneuron import RoboNeuronError

robot = RoboNeuron(RoboNeuronConfig(robot="so101", answer_timeout_s=0.4))
robot.connect()
told: dict[str, object] = {}


def send(name: str, **changes: float) -> None:
    state = robot.get_observation()
    measured = {key: float(state[key]) for key in robot.action_features}
    asked = measured | {
        f"{joint}.pos": measured[f"{joint}.pos"] + by for joint, by in changes.items()
    }
    told[name] = {"asked": asked, "sent": robot.send_action(asked), "measured": measured}
    time.sleep(0.6)


try:
    send("small", shoulder_pan=1.0)
    send("jump", shoulder_pan=40.0)
    for key, value in (("tail.pos", 0.0), ("gripper.pos", 140.0), ("elbow_flex.pos", float("nan"))):
        try:
            state = robot.get_observation()
            robot.send_action({k: float(state[k]) for k in robot.action_features} | {key: value})
            told[key] = "sent"
        except RoboNeuronError as error:
            told[key] = str(error)
finally:
    robot.disconnect()
print(json.dumps(told))
