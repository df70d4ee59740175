"""Preparation of a module process for the replacement of its module; called in every one of
them.
"""

from __future__ import annotations

from functools import partial

from std_msgs.msg import Empty

from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.module_host import Module, ModuleHost
from roboneuron.ros import qos
from roboneuron.switching.acceleration import AccelerationInForce
from roboneuron.switching.handover import TimedHandover
from roboneuron.switching.inference_handover import InferenceHandover
from roboneuron.switching.predecessor import follow_predecessor
from roboneuron.switching.standby import LISTENERS, restore

WARM_UP = "_warm_up"
"""std_msgs/Empty, hidden by the underscore in its name: opens the ports of a module in shadow."""
_LOOK_S = 0.05
_WARM_UPS, _WARM_UP_PERIOD_S = 30, 0.1


def join(host: ModuleHost) -> None:
    """Add the parameters for a handover and for another acceleration; see `FeatureSpec.on_join`."""
    handover = TimedHandover(host.settings.is_successor, host.status)
    host.filters.append(handover)
    for name, moment_ns in handover.moments.items():
        host.add_parameter(name, moment_ns, partial(handover.set, name), _refusal)
    host.on_configured.append(partial(_extend, host, handover))


def _extend(host: ModuleHost, handover: TimedHandover, module: Module) -> None:
    if isinstance(module, InferenceModule):
        module.filters.add(AccelerationInForce(host, module))
        module.filters.add(InferenceHandover(module, handover))
    module.node.subscribe(Empty, WARM_UP, lambda _: None)
    if host.settings.is_successor:
        follow_predecessor(module, handover)
        _open_ports(module)
    _count_listeners(module)
    restore()  # loaded: from now on with the same priority as other modules


def _count_listeners(module: Module) -> None:
    """Report the number of subscriptions of each output as `listeners.<topic>`: a successor must
    reach all subscribers of the old module.
    """
    known: dict[str, int] = {}

    def look() -> None:
        for topic, count_listeners in module.node.outputs.items():
            count = count_listeners()
            if count != known.get(topic):
                known[topic] = count
                module.status.set_value(f"{LISTENERS}{topic}", count)

    module.node.repeat(_LOOK_S, look)


def _open_ports(module: Module) -> None:
    """Pre-establish connections in shadow by sending a message to all modules: the first message to
    a process opens a port, which may take long.

    Fast DDS checks that a port's listener is alive. If it was checked a moment ago, this waits for
    a third of `healthy_check_timeout_ms`, inside publish() and with the GIL held.
    """
    node = module.node
    publisher = node.create_lifecycle_publisher(Empty, WARM_UP, qos.NEWEST)
    node.resources.callback(node.destroy_lifecycle_publisher, publisher)
    left = iter(range(_WARM_UPS))

    def send() -> None:
        if publisher.is_activated and next(left, None) is not None:
            publisher.publish(Empty())

    node.repeat(_WARM_UP_PERIOD_S, send)


def _refusal(moment_ns: int) -> str:
    return "it must be a ROS time in nanoseconds" if moment_ns < 0 else ""
