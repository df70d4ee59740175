"""Many threads that publish, take, call and send goals of learnt types at full speed.

    python busy_node.py SECONDS

Ends by itself with a line of what went through, at the earliest when each thing was done once; when
nothing goes on for half a minute, all stacks are printed and the process ends with 1.
"""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.action import ActionClient, ActionServer
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from rn_interfaces.finder import install

STILL_S = 30.0
"""Without a step of some thread: far more than a busy machine needs for one."""
PUBLISHERS = 4
SPINNERS = 4


def work(seconds: float) -> Counter[str]:
    """Let all threads run for some time and return how often each thing was done."""
    install()
    from weld_msgs.action import Weld
    from weld_msgs.msg import Path, Seam
    from weld_msgs.srv import Strike

    sys.setswitchinterval(1e-5)  # threads change places within what takes long otherwise
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node("busy", context=context)
    alone = Node("alone", context=context)  # an executor does not take it that entities come and go
    group = ReentrantCallbackGroup()
    done = Counter(dict.fromkeys(("published", "taken", "called", "goals", "created"), 0))
    until = time.monotonic() + seconds
    qos = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)

    def took(_: Path) -> None:
        done["taken"] += 1

    def strike(request: Strike.Request, response: Strike.Response) -> Strike.Response:
        response.message = request.seam.tool
        return response

    def weld(goal: Any) -> Weld.Result:
        goal.publish_feedback(Weld.Feedback(done=0.5))
        goal.succeed()
        return Weld.Result(length=1.0)

    for _ in range(2):
        node.create_subscription(Path, "/path", took, qos, callback_group=group)
    publisher = node.create_publisher(Path, "/path", qos)
    node.create_service(Strike, "/strike", strike, callback_group=group)
    client = node.create_client(Strike, "/strike", callback_group=group)
    server = ActionServer(node, Weld, "/weld", weld, callback_group=group)
    goals = ActionClient(node, Weld, "/weld", callback_group=group)
    executor = MultiThreadedExecutor(SPINNERS, context=context)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    assert client.wait_for_service(STILL_S)
    assert goals.wait_for_server(STILL_S)
    message = Path(seams=[Seam(currents=[float(one) for one in range(50)])] * 5, note="x" * 100)

    def publish() -> None:
        publisher.publish(message)
        done["published"] += 1

    def call() -> None:
        answered = threading.Event()
        future = client.call_async(Strike.Request(seam=Seam(tool="mag")))
        future.add_done_callback(lambda _: answered.set())
        if answered.wait(STILL_S):
            assert future.result().message == "mag"
            done["called"] += 1

    def send() -> None:
        answered = threading.Event()
        goals.send_goal_async(Weld.Goal()).add_done_callback(lambda _: answered.set())
        if answered.wait(STILL_S):
            done["goals"] += 1

    def create() -> None:
        other = alone.create_publisher(Path, "/path", qos)
        other.publish(message)
        alone.destroy_publisher(other)
        done["created"] += 1

    def repeat(step: Callable[[], None]) -> None:
        while time.monotonic() < until or not all(done.values()):
            step()

    steps = [*[publish] * PUBLISHERS, call, call, send, create]
    threads = [threading.Thread(target=repeat, args=(step,), daemon=True) for step in steps]
    for thread in threads:
        thread.start()
    seen: Counter[str] = Counter()
    while any(thread.is_alive() for thread in threads):
        if done != seen:
            seen = done.copy()
            faulthandler.dump_traceback_later(STILL_S, exit=True)
        time.sleep(0.2)
    faulthandler.cancel_dump_traceback_later()
    del server
    return done


if __name__ == "__main__":
    print(dict(work(float(sys.argv[1]))), flush=True)
    os._exit(0)  # what is measured is over; threads of rclpy may still be in its functions
