"""The box as a child process; a context manager to use with `FrankaSim`."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from fci_box.proxy import ASKING_PORT
from rn_robot_fr3.fci.counterpart import Counterpart


class ControlBox(Counterpart):
    """Serves the FCI on `host` as a client of franka-sim at `upstream`; see `proxy` for its
    requests.

    Args:
        host, upstream: addresses of 127.0.0.0/8.
        log: file for its output.
        seed: seed of the random losses.
    """

    name = "The control box"
    priority = 29

    def __init__(self, host: str, upstream: str, log: Path, seed: int = 1) -> None:
        super().__init__(host, ASKING_PORT, log)
        self._upstream, self._seed = upstream, seed

    def command(self) -> Sequence[str]:
        """The proxy, with this interpreter."""
        path = f"PYTHONPATH={Path(__file__).parents[1]}"
        module = ["env", path, sys.executable, "-m", "fci_box.proxy", "--host", self.host]
        return [*module, "--upstream", self._upstream, "--seed", str(self._seed)]
