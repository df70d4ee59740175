"""The feature: an executor in the process of every inference module; no part in the server."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from rn_standard.execution.adaptive import AdaptiveExecutor
from rn_standard.execution.mode import Mode, abilities_of, check_mode
from rn_standard.inference.execution import Bounds, ChunkExecutor, ExecutorMaker
from roboneuron import BackendSpec, Feature

if TYPE_CHECKING:
    from roboneuron.node import ModuleHost


class ExecutionFeature(Feature[None]):
    """Works only in modules, see `join`."""


def join(host: ModuleHost) -> None:
    """Install this package's executor in a module; called in every module process, see
    `FeatureSpec.on_join`.
    """
    host.provide(ExecutorMaker(make=make_executor))


def make_executor(backend: BackendSpec, execution: str, bounds: Bounds) -> ChunkExecutor:
    """Create an executor for that backend; see `ExecutorMaker`.

    Raises:
        ConfigurationError: `execution` fixes a mode that the backend does not support.
    """
    abilities = abilities_of(backend)
    fixed = None if execution == "auto" else cast("Mode", execution)
    if fixed is not None:
        check_mode(fixed, abilities, backend.name)
    return AdaptiveExecutor(abilities, fixed=fixed, bounds=bounds)
