"""A module process with faults on demand: the real node, protocol and parent watch around faulty
behaviour.

The fault is read from `[plugins.fault]` of the configuration: module kind -> word.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

from roboneuron.config import ModuleSettings
from roboneuron.errors import CheckpointError, UngroundedError
from roboneuron.modules.parent_watch import Signals, end_group, follow_parent
from roboneuron.modules.settings import INSTRUCTION_PARAMETER
from roboneuron.ros.claim import LEAVE_S, claim
from roboneuron.ros.environment import prepare_environment

parent = os.getppid()
follow_parent(parent)
prepare_environment()
settings = ModuleSettings.model_validate_json(sys.stdin.buffer.raw.readline())  # type: ignore[attr-defined]
held = claim(f"/{settings.status_name}", LEAVE_S)
fault = str(settings.config.options("fault").get(settings.kind, ""))
print(f"fake {settings.kind} with fault {fault!r}", flush=True)
if fault == "dies-at-once":
    print("cannot open the thing", flush=True)
    sys.exit(7)

import rclpy  # noqa: E402
from rcl_interfaces.msg import SetParametersResult  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

from roboneuron.modules.module import ModuleNode  # noqa: E402
from roboneuron.modules.module_host import Module  # noqa: E402


class FakeModule(Module):
    """Becomes ready on activation, except for its fault."""

    def __init__(self, node: ModuleNode) -> None:
        super().__init__(node)
        node.resources.callback(print, "closed", flush=True)
        if fault == "refuses-configure":
            raise CheckpointError(
                "The weights of 'fake' are truncated: 3 of 7 shards.", hint="Download them again."
            )
        if fault == "dies-in-configure":
            print("segmentation fault, not really", flush=True)
            os._exit(11)
        if fault == "hangs-in-configure":
            time.sleep(3600)
        if fault == "slow-configure":
            time.sleep(2.0)
        if fault == "has-a-child":
            child = subprocess.Popen(["sleep", "3600"])
            self.status.set_value("child_pid", child.pid)
        if fault == "has-a-child-that-reads":
            subprocess.Popen(["cat"], stdout=subprocess.DEVNULL)
        self.node.add_on_set_parameters_callback(self._on_parameters)
        if settings.kind == "inference":
            assert self.config.inference is not None
            self.node.declare_parameter(INSTRUCTION_PARAMETER, self.config.inference.instruction)

    def activate(self) -> None:
        if fault == "never-ready":
            self.status.set_waiting("images on camera/front/image")
        elif fault == "fails-when-active":
            error = UngroundedError("Nothing here is a 'red cube'.", hint="Name what is visible.")
            threading.Timer(0.2, self.status.set_error, [error]).start()
        else:
            self.status.set_value("detail.cube_z_m", "0.025")
            self.status.set_ready()
        if fault == "dies-when-ready":
            threading.Timer(0.4, os._exit, [13]).start()

    def deactivate(self) -> None:
        print("deactivated", flush=True)

    def _on_parameters(self, parameters: list[object]) -> SetParametersResult:
        for parameter in parameters:
            text = str(parameter.value)  # type: ignore[attr-defined]
            self.count = getattr(self, "count", 0) + 1
            self.status.clear_error()
            self.status.set(instruction=text)
            self.status.set(instruction_count=self.count)
            self.status.set(actions_for_instruction=0)
            if "unicorn" in text:
                self.status.set_error(UngroundedError(f"Nothing here is what {text!r} names."))
            elif text:
                self.status.set(actions_for_instruction=3)
            self.status.changed.set()
        return SetParametersResult(successful=True)


if fault == "loses-answers":
    from lifecycle_msgs.srv import ChangeState
    from rclpy.service import Service

    send = Service.send_response

    def lose(service: Service, response: object, header: object) -> None:
        """As if the node has not discovered the client of the answer yet."""
        if not isinstance(response, ChangeState.Response):
            send(service, response, header)

    Service.send_response = lose

rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
signals = Signals()
signals.listen()
if fault == "ignores-sigterm":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
node = ModuleNode(settings, FakeModule)
executor = SingleThreadedExecutor()
executor.add_node(node)
if fault == "reads-stdin-late":  # as if its thread gets no processor time
    heard = node.note_beat
    node.note_beat = lambda data: (time.sleep(0.1), heard(data))  # type: ignore[method-assign,func-returns-value]
node.watch_parent(signals.leave)
while not signals.is_leaving:
    executor.spin_once()
node.release()
node.destroy_node()
rclpy.try_shutdown()
end_group()
