"""What a module process needs so that its module can be replaced; called in every one of them."""

from __future__ import annotations

from functools import partial

from rn_standard.switching.acceleration import AccelerationInForce
from rn_standard.switching.handover import TimedHandover
from rn_standard.switching.predecessor import follow_predecessor
from rn_standard.switching.standby import restore
from roboneuron.feature import InferenceModule, Module, ModuleHost


def join(host: ModuleHost) -> None:
    """Let the server tell the moments of a handover, and another acceleration; see
    `FeatureSpec.on_join`.
    """
    handover = host.handover = TimedHandover(host.settings.shadow, host.status)
    for name, moment_ns in handover.moments.items():
        host.add_parameter(name, moment_ns, partial(handover.set, name), _refusal)
    host.on_configured.append(partial(_extend, host, handover))


def _extend(host: ModuleHost, handover: TimedHandover, module: Module) -> None:
    if isinstance(module, InferenceModule):
        AccelerationInForce(host, module)
        module.before_prediction.append(handover.rest)
    if host.settings.shadow:
        follow_predecessor(module, handover)
    restore()  # loaded: from now on as urgent as other modules


def _refusal(moment_ns: int) -> str:
    return "it must be a ROS time in nanoseconds" if moment_ns < 0 else ""
