from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rn_runtime_sglang.case import policy_model, write_checkpoint
from rn_runtime_sglang.config import SglangRuntimeConfig
from rn_runtime_sglang.runtime import SglangRuntime
from rn_runtime_sglang.served.fingerprint import served_name
from rn_runtime_sglang.standin.replies import Behaviour
from rn_runtime_sglang.standin.server import StandInServer
from rn_vla.decoding import PolicyModel

FAST: dict[str, Any] = {
    "poll_s": 0.05,
    "start_timeout_s": 30.0,
    "connect_timeout_s": 5.0,
    "timeout_s": 30.0,
}


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return write_checkpoint(tmp_path / "checkpoint")


@pytest.fixture
def model(checkpoint: Path) -> PolicyModel:
    return policy_model(checkpoint)


@pytest.fixture
def launch(checkpoint: Path) -> Iterator[Callable[..., StandInServer]]:
    """Start stand-ins that serve `checkpoint`; keyword arguments as in `Behaviour`."""
    started: list[StandInServer] = []

    def start(**changes: Any) -> StandInServer:
        told = {"served_name": served_name(checkpoint), "model_path": str(checkpoint), **changes}
        started.append(StandInServer(Behaviour(**told)).start())
        return started[-1]

    yield start
    for server in started:
        server.stop()


@pytest.fixture
def connect(model: PolicyModel) -> Iterator[Callable[..., SglangRuntime]]:
    """Create loaded runtimes for stand-ins; keyword arguments as in the configuration."""
    made: list[SglangRuntime] = []

    def load(*servers: StandInServer, **options: Any) -> SglangRuntime:
        runtime = SglangRuntime(
            SglangRuntimeConfig(**{**FAST, "urls": tuple(s.url for s in servers), **options})
        )
        made.append(runtime)
        runtime.load(model)
        return runtime

    yield load
    for runtime in made:
        runtime.close()
