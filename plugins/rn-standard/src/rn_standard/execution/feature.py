"""The feature: nothing to do in the server, an executor for the process of every inference
module.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rn_standard.execution.adaptive import AdaptiveExecutor
from rn_standard.execution.mode import Mode, abilities_of, check_mode
from roboneuron import BackendSpec, Feature
from roboneuron.feature import execution as core_execution

if TYPE_CHECKING:
    from roboneuron.feature import ModuleHost


class ExecutionFeature(Feature[None]):
    """Works in the modules alone, see `join`."""


def join(host: ModuleHost) -> None:
    """Give a module the executor of this package; called in every module process, see
    `FeatureSpec.on_join`.
    """
    host.make_executor = make_executor


def make_executor(
    backend: BackendSpec, execution: str, bounds: core_execution.Bounds
) -> core_execution.ChunkExecutor:
    """An executor for that backend, as `ModuleHost.make_executor` says.

    Raises:
        ConfigurationError: `execution` fixes a mode that the backend cannot do.
    """
    abilities = abilities_of(backend)
    fixed = None if execution == "auto" else cast("Mode", execution)
    if fixed is not None:
        check_mode(fixed, abilities, backend.name)
    return AdaptiveExecutor(abilities, fixed=fixed, bounds=bounds)
