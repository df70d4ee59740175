"""The backend's contract case: RoboNeuron's own server with a small model, in threads."""

from __future__ import annotations

import atexit
import functools
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import InterfaceOptions, OpenpiOptions
from rn_backend_openpi.plugin import BACKEND
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.shared_options import (
    ListenOptions,
    PolicyServerOptions,
    ServedModelOptions,
    SharedOptions,
)
from rn_testing import BackendCase
from roboneuron import EE_DELTA, ActionChunk, Backend, BackendSpec, ControlSpace, Observation

_START_S = 30.0
REFLEX = BackendSpec(
    name="reflex",
    summary="One layer over the mean colours of the picture.",
    target=f"{__name__}:Reflex",
    needs_state=True,
)
"""Descriptor of the small model."""


class Reflex:
    """One layer over the mean colours of the picture and the state; a `Backend` of batches.

    Args:
        space: control space of its rows.
        step_s: time between two rows [s].
    """

    def __init__(self, space: ControlSpace = EE_DELTA, step_s: float = 0.1) -> None:
        self._space, self._step_s = space, step_s
        self._weights = np.random.default_rng(0).standard_normal((8, 4 * space.size))

    def load(self) -> None:
        """Nothing to load."""

    def predict_batch(self, observations: Sequence[Observation]) -> Sequence[ActionChunk]:
        """A chunk of four rows for each observation."""
        return [self.predict(observation) for observation in observations]

    def predict(self, observation: Observation) -> ActionChunk:
        """The chunk of one observation."""
        image = observation.frames["primary"].image
        half = image.shape[1] // 2
        colours = [*image[:, :half].mean((0, 1)), *image[:, half:].mean((0, 1))]
        joints = observation.joints
        state = 0.0 if joints is None else float(joints.position.sum())
        seen = [*(np.array(colours) / 255.0), len(observation.instruction) / 100.0, state]
        rows = 0.01 * np.tanh(np.array(seen) @ self._weights).reshape(4, -1)
        for column, key in enumerate(self._space.keys):
            if key.endswith("gripper_open"):
                rows[:, column] += 0.5
        for part in self._space.quaternions:
            rows[:, part] /= np.linalg.norm(rows[:, part], axis=1, keepdims=True)
        return ActionChunk(actions=rows, step_s=self._step_s, space=self._space)

    def reset(self) -> None:
        """Nothing to forget."""

    def close(self) -> None:
        """Nothing to release."""


class HeldModel(SharedModel):
    """A served model that exists already.

    Args:
        options: those of its server.
        backend: not loaded.
        spec: its descriptor.
        space: control space of its rows.
    """

    def __init__(
        self, options: SharedOptions, backend: Backend, spec: BackendSpec, space: ControlSpace
    ) -> None:
        super().__init__(options)
        self._held, self._space = (spec, backend), space

    def _built(self) -> tuple[BackendSpec, Backend]:
        return self._held

    def _space_for(self, interface: InterfaceOptions) -> ControlSpace:
        return self._space


class ModelThread(ModelProcess):
    """The server of a model in a thread instead of a process.

    Args:
        server: listens at `path`.
        given: as of `ModelProcess`.
    """

    def __init__(self, server: SharedModelServer, *given: Any) -> None:
        super().__init__(*given)
        self._server = server
        self._running = threading.Thread(target=server.run, daemon=True)

    @property
    def state(self) -> str:
        """See `ModelProcess`."""
        return str(self._server.status()["state"])

    def start(self) -> None:
        """Start the thread."""
        self._running.start()

    def stop(self) -> None:
        """Request the end."""
        self._server.stop()

    def close(self) -> None:
        """Wait for the end."""
        self.stop()
        self._running.join(_START_S)


@contextmanager
def serving(
    options: OpenpiOptions,
    backend: Backend,
    spec: BackendSpec = REFLEX,
    *,
    space: ControlSpace = EE_DELTA,
    **listen: Any,
) -> Iterator[str]:
    """Run a policy server in threads while the block runs; yields its URL.

    Args:
        options: of the interface and of the server.
        backend: the served model.
        spec: its descriptor.
        space: control space of its rows.
        listen: options of `[listen]`; by default a free port without a key.
    """
    model = ServedModelOptions(
        backend=spec.name, interface=options.interface(), most=options.server.most
    )
    listening = {"port": 0, "keys": "none", "robots": options.server.clients, **listen}
    served = PolicyServerOptions(
        listen=ListenOptions.model_validate(listening), models={spec.name: model}
    )
    is_ready = threading.Event()
    with tempfile.TemporaryDirectory(prefix="rn-") as name:
        folder = Path(name)
        server = PolicyServer(served, folder, "case", lambda port: is_ready.set())
        path = folder / "model.sock"
        held = HeldModel(model.shared(), backend, spec, space)
        one = SharedModelServer(model.shared(), path, None, held)
        server.models[spec.name] = ModelThread(one, spec.name, model, path)
        thread = threading.Thread(target=server.run, name="policy-server", daemon=True)
        thread.start()
        try:
            if not is_ready.wait(_START_S):
                raise TimeoutError("the server does not listen")
            scheme = "ws" if served.listen.certificate is None else "wss"
            yield f"{scheme}://{served.listen.host}:{server.port}"
        finally:
            server.stop()
            thread.join(_START_S)


def openpi_case() -> BackendCase:
    """`openpi` with a server that runs until the process exits."""
    return BackendCase(spec=BACKEND, options={"profile": "roboneuron", "url": _url()})


@functools.cache
def _url() -> str:
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(serving(OpenpiOptions(profile="roboneuron"), Reflex()))
