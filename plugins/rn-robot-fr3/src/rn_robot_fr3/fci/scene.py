"""Scene of a simulator behind the network protocol: for cameras and judge, never for policies."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Mapping

import numpy as np
from std_msgs.msg import Float64MultiArray

from rn_robot_fr3.cell import FR3
from rn_simulation.cubes import Cube
from rn_simulation.engine import choose_engine
from rn_simulation.ground_truth import LiftClock, told
from rn_simulation.scene_state import TOPIC, SceneState, to_message
from roboneuron import NotReadyError, Topics

_PERIOD_S = 1.0 / 60.0
_ANSWER_S = 2.0
_JOIN_S = 3.0


class SceneFeed:
    """Requests the scene from the simulator and publishes it on `sim/state` for
    `SimulatedFr3Cameras`.
    """

    def __init__(self, address: str, topics: Topics) -> None:
        """`address` is host:port of `rn_robot_fr3.fci.simulator`."""
        host, port = address.rsplit(":", 1)
        self._address = (host, int(port))
        self._topics = topics
        self._publish: Callable[[Float64MultiArray], None] | None = None
        self._socket: socket.socket | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._lifts: LiftClock | None = None
        self._detail: dict[str, str] = {}

    def open(self) -> None:
        """Start. Raises NotReadyError if the simulator does not answer."""
        if self._publish is None:
            self._publish = self._topics.advertise(TOPIC, Float64MultiArray)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(_ANSWER_S)
        self._socket.connect(self._address)
        self._stop.clear()
        try:
            self._ask()
        except OSError as error:
            raise NotReadyError(
                f"No scene at {self._address[0]}:{self._address[1]}: {error}.",
                hint="Leave out the option `scene` for a real arm; make demo-fr3 starts the "
                "simulator that has one.",
            ) from error
        self._thread = threading.Thread(target=self._run, name="fci-scene", daemon=True)
        self._thread.start()

    def detail(self) -> Mapping[str, str]:
        """Cubes and time of the simulator, in the form of the driver `simulated`."""
        return self._detail

    def close(self) -> None:
        """Stop; may be called twice."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            due_s = max(due_s + _PERIOD_S, time.monotonic())
            try:
                self._ask()
            except OSError:
                self._stop.wait(_ANSWER_S / 10)

    def _ask(self) -> None:
        assert self._socket is not None
        assert self._publish is not None
        self._socket.send(b"{}")
        said = json.loads(self._socket.recv(65536))
        sizes = {name: float(edge_m) for name, edge_m in said["cubes"]}
        poses = {
            name: (pose[:3], pose[3:]) for name, pose in zip(sizes, said["poses"], strict=True)
        }
        if self._lifts is None:
            self._lifts = LiftClock(
                [Cube(name=n, edge_m=e, x_m=0.0, y_m=0.0, yaw_rad=0.0) for n, e in sizes.items()]
            )
        self._lifts.observe(float(said["time_s"]), poses)
        state = SceneState(
            robot=FR3.robot,
            engine=choose_engine("auto"),
            seed=int(said["seed"]),
            cubes=tuple(sizes.items()),
            joints=np.array(said["joints"], dtype=np.float64),
            cube_poses=np.array(said["poses"], dtype=np.float64).reshape(len(sizes), 7),
            stamp_ns=self._topics.now_ns(),
        )
        self._publish(to_message(state))
        self._detail = {
            "sim_time_s": f"{float(said['time_s']):.3f}",
            "engine": "franka-sim",
            **told(self._lifts.states(poses), int(said["seed"])),
        }
