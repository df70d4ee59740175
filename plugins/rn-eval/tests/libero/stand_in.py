"""Implements the simulator's protocol: the arm does not move, and three closing actions in a row
complete the task.
"""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from rn_eval.libero.simulator import __main__ as main
from rn_eval.libero.simulator.pipe import Image, State


class StandIn:
    def __init__(self):
        self.steps, self.closed = 0, 0

    def open(self, suite, task, state, image_px):
        self.steps, self.closed, self.size = 0, 0, image_px
        self.suite, self.task, self.number = suite, task, state
        return self.state()

    def step(self, action):
        if action[0] > 0.9:
            os._exit(3)
        if action[0] < -0.9:
            time.sleep(60)
        self.steps += 1
        self.closed = self.closed + 1 if action[6] > 0 else 0
        if action[1] > 0.9:
            raise RuntimeError("the simulation is unstable")
        return self.state()

    def render(self, camera):
        pixels = np.zeros((self.size, self.size, 3), np.uint8)
        pixels[0, 0] = (self.number, self.steps % 256, 200)
        return Image(pixels=pixels)

    def close(self):
        pass

    def state(self):
        from rn_eval.libero.suite import tasks_of

        return State(
            instruction=tasks_of(self.suite)[self.task][1],
            is_done=self.closed == 3,
            joints=np.array([0.0] * 7 + [0.04, -0.04]),
            eef_pos=np.array([0.1, 0.2, 0.3]),
            eef_quat=np.array([1.0, 0.0, 0.0, 0.0]),
            flat=np.array([float(self.steps)]),
        )


if __name__ == "__main__":
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    print("this must not disturb the protocol")
    main.serve(sys.stdin.buffer, sink, StandIn())
