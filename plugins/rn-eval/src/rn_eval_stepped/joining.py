"""The clock of a simulation that waits for commands, in a module's process."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rn_eval_stepped.world_clock import is_stepped

if TYPE_CHECKING:
    from roboneuron.feature import Module, ModuleHost
    from roboneuron.modules.control.module import ControlModule


def join(host: ModuleHost) -> None:
    """Pace inference and control of a robot with the option `stepped`."""
    if not is_stepped(host.settings.config):
        return
    if host.settings.kind == "inference":
        from rn_eval_stepped.chunks import SteppedRows  # heavy

        host.filters.append(SteppedRows(host))
    if host.settings.kind == "control":
        host.on_configured.append(_pace)


def _pace(module: Module) -> None:
    from rn_eval_stepped.actions import SteppedActions  # heavy

    module.filters.add(SteppedActions(cast("ControlModule", module)))
