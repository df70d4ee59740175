"""The feature: an executor in the process of every inference module; no part in the server."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from roboneuron.modules.execution.adaptive import AdaptiveExecutor
from roboneuron.modules.execution.mode import Mode, abilities_of, check_mode
from roboneuron.modules.inference.execution import Bounds, ChunkExecutor
from roboneuron.modules.step_filters import StepFilter
from roboneuron.plugins.specs import BackendSpec
from roboneuron.server.feature import Feature

if TYPE_CHECKING:
    from roboneuron.modules.module_host import ModuleHost


class ExecutionFeature(Feature[None]):
    """Works only in modules, see `join`."""


def join(host: ModuleHost) -> None:
    """Install this package's executor in a module; called in every module process, see
    `FeatureSpec.on_join`.
    """
    host.filters.append(AdaptiveExecution())


class AdaptiveExecution(StepFilter):
    """Offers the executor of this package."""

    phase = StepFilter.StepPhase.EXECUTION

    def executor(self, backend: BackendSpec, mode: str, bounds: Bounds) -> ChunkExecutor:
        """See `StepFilter.executor`."""
        fixed = None if mode == "auto" else cast("Mode", mode)
        if fixed is not None:
            check_mode(fixed, abilities_of(backend), backend.name)
        return AdaptiveExecutor.of(backend, fixed=fixed, bounds=bounds)
