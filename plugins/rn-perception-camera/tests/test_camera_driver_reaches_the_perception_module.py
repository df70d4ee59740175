"""A camera driver, the perception module and the test as three processes on one ROS graph."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_testing.domain import free_ros_domain

pytestmark = pytest.mark.ros
HERE = Path(__file__).parent
RESIZE = {"width": 32, "height": 32, "fit": "letterbox"}
OPTIONS = {
    "cameras": {
        "front": {
            "topic": "/usb/image_raw",
            "camera_info": "/usb/camera_info",
            "depth": "/usb/depth",
            "resize": RESIZE,
        },
        "side": {
            "topic": "/usb/image_raw/compressed",
            "transport": "compressed",
            "max_rate_hz": 10.0,
        },
    }
}


class Graph:
    """A node of the test, and the processes that it started."""

    def __init__(self, folder: Path) -> None:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
        from roboneuron.ros.environment import prepare_environment

        prepare_environment(folder)
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("looks_at_cameras")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        site = folder / "site"
        information = site / "rn_cell-1.0.dist-info"
        information.mkdir(parents=True)
        shutil.copy(HERE / "camera_cell.py", site)
        (information / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: rn-cell\nVersion: 1.0\n"
        )
        (information / "entry_points.txt").write_text("[roboneuron]\nrn-cell = camera_cell\n")
        self.environment = {**os.environ, "PYTHONPATH": str(site)}

    def wait_for(self, condition: Callable[[], bool], what: str, limit_s: float = 60.0) -> None:
        deadline_s = time.monotonic() + limit_s
        while not condition():
            assert time.monotonic() < deadline_s, f"waited in vain: {what}"
            self.executor.spin_once(timeout_sec=0.02)

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        with (self.folder / "processes.log").open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, *command],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env=self.environment,
            )
        self.processes.append(process)
        return process

    def start_perception(self, options: dict[str, Any]) -> None:
        from lifecycle_msgs.srv import ChangeState

        config = {
            "robot": {"name": "cell"},
            "perception": {"source": "ros-camera"},
            "plugins": {"ros-camera": options},
        }
        settings = {
            "kind": "perception",
            "node_name": "perception",
            "config": config,
            "state_directory": str(self.folder),
        }
        process = self.start("-m", "roboneuron.modules")
        assert process.stdin is not None
        process.stdin.write(json.dumps(settings).encode() + b"\n")
        process.stdin.flush()
        client = self.node.create_client(ChangeState, "/cell/perception/change_state")
        self.wait_for(client.service_is_ready, "perception to offer its lifecycle")
        for transition in (1, 3):  # configure, activate
            request = ChangeState.Request()
            request.transition.id = transition
            future = client.call_async(request)
            self.wait_for(future.done, f"transition {transition}")
            assert future.result().success, (self.folder / "processes.log").read_text()

    def listen(self, message_type: Any, topic: str) -> list[Any]:
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, 5)
        return received

    def end(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdin is not None
        process.stdin.close()  # as when the parent ends
        process.wait(15.0)

    def close(self) -> None:
        import rclpy

        for process in self.processes:
            self.end(process)
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    made = Graph(tmp_path)
    yield made
    made.close()


def test_images_arrive_with_stamps_and_calibration_and_drivers_may_change(graph: Graph) -> None:
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import CameraInfo, Image

    statuses = graph.listen(DiagnosticArray, "/diagnostics")
    fronts, sides = (
        graph.listen(Image, f"/cell/camera/{name}/image") for name in ("front", "side")
    )
    infos = graph.listen(CameraInfo, "/cell/camera/front/camera_info")
    depths = graph.listen(Image, "/cell/camera/front/depth")
    driver = graph.start(str(HERE / "camera_driver.py"), "best_effort")
    graph.start_perception(OPTIONS)
    graph.wait_for(
        lambda: min(map(len, (fronts, sides, infos, depths))) > 5, "images of both cameras"
    )

    for message in fronts:
        pixels = np.frombuffer(message.data, dtype=np.uint8).reshape(32, 32, 3)
        assert message.header.frame_id == "usb_optical"
        # image and stamp belong
        assert pixels[16, 16].tolist() == [200, 100, message.header.stamp.nanosec % 1000]
        assert not pixels[:4].any()
        assert not pixels[28:].any()
    for message in depths:
        depth_m = np.frombuffer(message.data, dtype="<f4").reshape(32, 32)
        assert message.encoding == "32FC1"
        expected_m = (500 + message.header.stamp.nanosec % 1000) / 1000
        assert depth_m[16, 16] == pytest.approx(expected_m), "depth and stamp belong"
        assert np.isnan(depth_m[:4]).all(), "nothing is measured in the bars"
    shown = [m.header.stamp for m in fronts]
    assert any(m.header.stamp in shown for m in depths), "a depth has the stamp of its image"
    assert (sides[-1].width, sides[-1].height, sides[-1].encoding) == (64, 48, "rgb8")
    assert sides[-1].data[2] == sides[-1].header.stamp.nanosec % 1000
    stamps_s = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in sides]
    assert (stamps_s[-1] - stamps_s[0]) / (len(sides) - 1) > 0.05  # 50 Hz come, 10 Hz leave
    # half the size, below a bar of four pixels; ROS' pixel centres are at integers
    assert infos[-1].k.tolist() == [25.0, 0.0, 14.75, 0.0, 25.0, 13.75, 0.0, 0.0, 1.0]
    assert infos[-1].header.stamp in [m.header.stamp for m in fronts]

    graph.end(driver)

    def reason() -> str:
        return " ".join(status.message for array in statuses[-4:] for status in array.status)

    graph.wait_for(
        lambda: "Nobody publishes images of camera 'front' on topic '/usb/image_raw'" in reason(),
        "a reason",
    )
    fronts.clear()
    graph.start(str(HERE / "camera_driver.py"), "reliable")
    graph.wait_for(lambda: len(fronts) > 2, "images of the new driver")


@pytest.mark.exhaustive
def test_images_inside_learnt_messages_arrive(graph: Graph) -> None:
    """Of types that nobody has compiled: `roboneuron ros learn` reads their definitions."""
    pytest.importorskip("rn_interfaces", reason="rn-interfaces makes types at run time")
    from sensor_msgs.msg import Image

    definitions = graph.folder / "src" / "rig_msgs" / "msg"
    definitions.mkdir(parents=True)
    (definitions / "View.msg").write_text("string name\nsensor_msgs/Image picture\n")
    (definitions / "Views.msg").write_text(
        "View[] views\nsensor_msgs/CompressedImage overview\nfloat64 gain\n"
    )
    graph.environment["XDG_DATA_HOME"] = str(graph.folder / "data")
    graph.environment["XDG_CACHE_HOME"] = str(graph.folder / "cache")
    learn = graph.start("-m", "roboneuron.cli.main", "ros", "learn", str(graph.folder / "src"))
    assert learn.wait(60.0) == 0, (graph.folder / "processes.log").read_text()
    fronts, sides = (
        graph.listen(Image, f"/cell/camera/{name}/image") for name in ("front", "side")
    )
    graph.start(str(HERE / "rig_driver.py"))
    common = {"topic": "/rig/views", "type": "rig_msgs/msg/Views"}
    side = {**common, "field": "overview", "transport": "compressed"}
    graph.start_perception(
        {"cameras": {"front": {**common, "field": "views[1].picture"}, "side": side}}
    )
    graph.wait_for(lambda: len(fronts) > 5 and len(sides) > 5, "images of both cameras")

    for received, colour in ((fronts, [9, 100]), (sides, [200, 100])):
        for message in received:
            assert (message.width, message.height, message.encoding) == (64, 48, "rgb8")
            pixel = [*colour, message.header.stamp.nanosec % 1000]
            assert list(message.data[:3]) == pixel, "image and stamp belong together"
            assert message.header.frame_id == "rig_optical"
