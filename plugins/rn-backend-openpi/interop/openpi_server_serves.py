"""openpi's own websocket server with a small policy; run by the interpreter of openpi-client,
without RoboNeuron.

    python openpi_server_serves.py OPENPI PORT WIDTH

OPENPI is a checkout of openpi: its file src/openpi/serving/websocket_policy_server.py is loaded,
which needs only openpi-client. The answer to a request is float32 (10, WIDTH): row i holds i plus
the sum of every array of the request, each in its own column; "fail" as prompt is an error.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
from openpi_client.base_policy import BasePolicy


class Sums(BasePolicy):
    """The policy described above."""

    def __init__(self, width: int) -> None:
        self._width = width

    def infer(self, obs: dict) -> dict:
        if obs["prompt"] == "fail":
            raise ValueError("the policy failed on purpose")
        rows = np.tile(np.arange(10.0)[:, None], (1, self._width))
        arrays = [obs[key] for key in sorted(obs) if isinstance(obs[key], np.ndarray)]
        for column, array in enumerate(arrays):
            rows[:, column] += array.astype(np.float64).sum()
        actions = (rows / 1e9).astype(np.float32)
        return {"actions": actions, "policy_timing": {"infer_ms": np.float64(1.5)}}

    def reset(self) -> None:
        """Nothing to reset."""


def main(checkout: str, port: str, width: str) -> None:
    """Serve forever."""
    path = Path(checkout) / "src" / "openpi" / "serving" / "websocket_policy_server.py"
    spec = importlib.util.spec_from_file_location("websocket_policy_server", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    server = module.WebsocketPolicyServer(
        Sums(int(width)), host="127.0.0.1", port=int(port), metadata={"policy": "sums"}
    )
    server.serve_forever()


if __name__ == "__main__":
    main(*sys.argv[1:])
