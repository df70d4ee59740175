"""A test robot in its own process: sends requests to a policy server repeatedly, and writes the
answers.

Arguments: file to write, options of `[plugins.shared]` as JSON, side of its images [px].
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import replace

import numpy as np

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import Reflex, ReflexOptions
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import SHARED
from rn_testing.fakes.backend import make_observation
from roboneuron import RoboNeuronError

PAUSE_S = 0.02


def main(path: str, options: str, side: str) -> None:
    """Send requests until killed; each line gives the time of an answer, and whether it was the
    right one for the observation.
    """
    backend = PolicyBackend(PolicyOptions.model_validate_json(options))
    backend.load()
    alone = Reflex(ReflexOptions())
    alone.load()
    seen = make_observation(SHARED)
    drawn = np.random.default_rng(0)
    image = drawn.integers(0, 256, (int(side), int(side), 3), dtype=np.uint8)
    frame = replace(seen.frames["primary"], image=image)
    assert seen.ee_pose is not None
    with open(path, "a", buffering=1) as told:
        while True:
            pose = replace(seen.ee_pose, position_m=drawn.normal(size=3))
            observation = replace(seen, frames={"primary": frame}, ee_pose=pose)
            line: dict[str, object] = {}
            begun_s = time.monotonic()
            try:
                chunk = backend.predict(observation)
                far = np.abs(chunk.actions - alone.predict(observation).actions).max()
                line = {"ok": True, "far": float(far), "coding": chunk.metrics["shared.coding"]}
            except RoboNeuronError as error:
                line = {"ok": False, "error": error.code, "message": error.message}
            line |= {"at_s": begun_s, "took_s": time.monotonic() - begun_s}
            told.write(json.dumps(line) + "\n")
            time.sleep(PAUSE_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
