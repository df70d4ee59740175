"""RoboArena's own client or server; run by the interpreter of openpi-client, without RoboNeuron.

    python roboarena_peer.py ROBOARENA ask PORT       # prints metadata, shape and answer to a reset
    python roboarena_peer.py ROBOARENA serve PORT     # rows (5, 8): 0.25 and the number of requests

ROBOARENA is a checkout of https://github.com/robo-arena/roboarena.
"""

from __future__ import annotations

import sys

import numpy as np


def ask(port: int) -> None:
    """Send one request like RoboArena's evaluation."""
    from roboarena.policy_client import WebsocketClientPolicy
    from roboarena.policy_server import PolicyServerConfig

    client = WebsocketClientPolicy("127.0.0.1", port)
    config = PolicyServerConfig(**client.get_server_metadata())
    height, width = config.image_resolution
    keys = [f"exterior_image_{i}_left" for i in range(config.n_external_cameras)]
    keys += ["wrist_image_left"] * config.needs_wrist_camera
    request = {f"observation/{key}": np.zeros((height, width, 3), dtype=np.uint8) for key in keys}
    for name, count in (("joint", 7), ("cartesian", 6), ("gripper", 1)):
        request[f"observation/{name}_position"] = np.zeros(count, dtype=np.float32)
    actions = client.infer({**request, "prompt": "test", "session_id": "a"})["actions"]
    print(config.action_space, actions.shape, client.reset({"session_id": "a"}))


def serve(port: int) -> None:
    """Serve forever with RoboArena's server."""
    from roboarena.policy import BasePolicy
    from roboarena.policy_server import PolicyServerConfig, WebsocketPolicyServer

    class Counting(BasePolicy):
        """Counts requests since the last reset."""

        count = 0

        def infer(self, obs: dict) -> dict:
            assert obs["observation/exterior_image_0_left"].shape == (180, 320, 3)
            assert isinstance(obs["session_id"], str)
            self.count += 1
            rows = np.full((5, 8), 0.25, dtype=np.float32)
            rows[:, 6] = self.count
            return {"actions": rows}

        def reset(self, reset_info: dict) -> None:
            self.count = 0

    config = PolicyServerConfig(
        image_resolution=(180, 320), needs_wrist_camera=False, needs_session_id=True
    )
    WebsocketPolicyServer(Counting(), config, "127.0.0.1", port).serve_forever()


if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    {"ask": ask, "serve": serve}[sys.argv[2]](int(sys.argv[3]))
