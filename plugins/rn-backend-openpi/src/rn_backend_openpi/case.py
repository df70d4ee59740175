"""The backend's contract case: RoboNeuron's own server with a small model, in threads; and that
model as a plugin for servers in processes.
"""

from __future__ import annotations

import atexit
import functools
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict

from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.interface_options import InterfaceOptions
from rn_backend_openpi.listener import address_of
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import ModelOptions
from rn_backend_openpi.plugin import BACKEND, SHARED
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.server_options import PolicyServerOptions, ServedModelOptions
from rn_testing import BackendCase
from rn_testing.fakes.site import PluginSite
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    Backend,
    BackendSpec,
    CheckpointError,
    ControlSpace,
    InvalidInputError,
    Observation,
    UnsafeError,
)

_START_S = 30.0
PLUGIN = """
from roboneuron import BackendSpec, hookimpl

MODEL = "rn_backend_openpi.case"


@hookimpl
def roboneuron_backends():
    common = {"config": MODEL + ":ReflexOptions", "needs_state": True}
    return [
        BackendSpec(name="reflex", summary="Small.", target=MODEL + ":Reflex",
                    conditions_on_rows=True, optional_cameras=("wrist",), **common),
        BackendSpec(name="rememberer", summary="Not sharable.", target=MODEL + ":Rememberer",
                    **common),
    ]
"""
"""The small model as a plugin, installed only where a server is to find it."""
REFLEX = BackendSpec(
    name="reflex",
    summary="One layer over the mean colours of the picture and the state.",
    target=f"{__name__}:Reflex",
    needs_state=True,
)
"""Descriptor of the small model in this process."""


class ReflexOptions(BaseModel):
    """Options of the small model."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    rows: int = 4
    step_s: float = 0.1
    gain: float = 0.01
    """Size of the first row; the others are its multiples."""
    took_s: float = 0.0
    fails: bool = False
    """Raise while it is loaded."""
    shrinks_to: tuple[int, int] | None = None
    """Width and height to which it shrinks images [px]."""
    continues: bool = True
    sees_hand: bool = True
    """Read pose and gripper, which not every interface has."""


class Reflex:
    """One layer over the mean colours of the picture and the state; a `Backend` that answers any
    number of observations with one matrix product.

    Args:
        config: its options.
        space: control space of its rows.
    """

    def __init__(
        self,
        config: ReflexOptions | None = None,
        *,
        runtime: object = None,
        acceleration: object = None,
        space: ControlSpace = EE_DELTA,
    ) -> None:
        self._options, self._space = config or ReflexOptions(), space
        self._weights = np.random.default_rng(0).standard_normal((12, space.size))
        self._asked = 0

    def load(self) -> None:
        """Load nothing. Raises CheckpointError if the options say so."""
        if self._options.fails:
            raise CheckpointError("There are no weights.", hint="Copy some.")

    @property
    def continues_rows(self) -> bool:
        """See `SharedModel`."""
        return self._options.continues

    @property
    def image_sizes(self) -> Mapping[str, tuple[int, int]]:
        """See `SharedModel`."""
        size = self._options.shrinks_to
        return {} if size is None else {"primary": size}

    def predict(self, observation: Observation) -> ActionChunk:
        """The chunk of one observation; it continues rows ahead."""
        chunk, ahead = Reflex.predict_batch(self, [observation])[0], observation.ahead
        if ahead is None or not len(ahead.rows):
            return chunk
        rows, count = chunk.actions.copy(), min(ahead.committed_rows, len(chunk.actions))
        rows[:count] = ahead.rows[:count]
        context: Any = ahead.context
        continued = -1.0 if context is None else context["row"] + ahead.context_row
        return replace(
            chunk, actions=rows, conditioned_rows=count, metrics={"continues": continued}
        )

    def predict_batch(self, observations: Sequence[Observation]) -> Sequence[ActionChunk]:
        """A chunk for each observation."""
        seen = np.array([self._seen(observation) for observation in observations])
        time.sleep(self._options.took_s)
        # each sum in one order, so that a batch has the bits of single observations
        sums = (seen[:, :, None] * self._weights).sum(axis=1)
        moves = self._options.gain * np.tanh(sums)
        self._asked += len(moves)
        return [
            ActionChunk(
                actions=self._rows(move),
                step_s=self._options.step_s,
                space=self._space,
                context={"row": 100.0 * self._asked},
            )
            for move in moves
        ]

    def _seen(self, observation: Observation) -> list[float]:
        if observation.instruction == "crash":
            raise InvalidInputError("not that")
        joints, pose = observation.joints, observation.ee_pose
        state = [0.0 if joints is None else float(joints.position.sum()), 0.0, 0.0, 0.0, 0.0]
        if self._options.sees_hand:
            state[1:4] = np.zeros(3) if pose is None else pose.position_m
            state[4] = observation.gripper_open or 0.0
        if not np.isfinite(state).all():
            raise UnsafeError("the state is not finite")
        image = observation.frames["primary"].image
        if self._options.shrinks_to is not None:
            shrunk = Image.fromarray(image).resize(
                self._options.shrinks_to, Image.Resampling.BILINEAR
            )
            image = np.asarray(shrunk)
        half = image.shape[1] // 2
        colours = [*image[:, :half].mean((0, 1)), *image[:, half:].mean((0, 1))]
        return [*np.array([*colours, len(observation.instruction)]) / 255.0, *state]

    def _rows(self, move: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
        rows = np.outer(np.arange(self._options.rows) + 1.0, move)
        for column, key in enumerate(self._space.keys):
            if key.endswith("gripper_open"):
                rows[:, column] = 0.5
        for part in self._space.quaternions:
            rows[:, part] /= np.linalg.norm(rows[:, part], axis=1, keepdims=True)
        return rows

    def reset(self) -> None:
        """Nothing to forget."""

    def close(self) -> None:
        """Nothing to release."""


class Rememberer(Reflex):
    """The same without batches, as a model that remembers."""

    predict_batch = None  # type: ignore[assignment]


class HeldModel(SharedModel):
    """A served model that exists already.

    Args:
        options: those of its server.
        backend: not loaded.
        spec: its descriptor.
        space: control space of its rows.
    """

    def __init__(
        self, options: ModelOptions, backend: Backend, spec: BackendSpec, space: ControlSpace
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
    backend: Backend,
    spec: BackendSpec = REFLEX,
    *,
    interface: Mapping[str, object] | None = None,
    space: ControlSpace = EE_DELTA,
    **listen: Any,
) -> Iterator[str]:
    """Run a policy server in threads while the block runs; yields its URL.

    Args:
        backend: the served model.
        spec: its descriptor.
        interface: for clients of openpi's kind.
        space: control space of its rows.
        listen: options of `[listen]`; by default a free port without a key.
    """
    tables = {
        "listen": {"port": 0, "keys": "none", **listen},
        "models": {spec.name: {"backend": spec.name, "interface": interface}},
    }
    served = PolicyServerOptions.model_validate(tables)
    is_ready = threading.Event()

    def make(name: str, given: ServedModelOptions, path: Path) -> ModelThread:
        held = HeldModel(given, backend, spec, space)
        return ModelThread(SharedModelServer(given, path, None, held), name, given, path)

    with tempfile.TemporaryDirectory(prefix="rn-") as folder:
        server = PolicyServer(served, Path(folder), "case", lambda port: is_ready.set(), make)
        thread = threading.Thread(target=server.run, name="policy-server", daemon=True)
        thread.start()
        try:
            if not is_ready.wait(_START_S):
                raise TimeoutError("the server does not listen")
            scheme = "ws" if served.listen.certificate is None else "wss"
            yield f"{scheme}://{address_of(served.listen.host, server.port)}"
        finally:
            server.stop()
            thread.join(_START_S)


def policy_case() -> BackendCase:
    """`shared` with the backend `reflex`, which exists only in the server's process."""
    return BackendCase(
        spec=SHARED,
        options=options_in(_folder(), idle_s=5.0, options={"rows": 6}),
        row_tolerance=1e-12,
        rows=6,
    )


def openpi_case() -> BackendCase:
    """The same under the name `openpi`."""
    return replace(policy_case(), spec=BACKEND)


def options_in(folder: Path, **options: object) -> dict[str, Any]:
    """Options for a server in its own folder that finds the small model."""
    path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
    return {
        "backend": "reflex",
        "directory": str(folder / "run"),
        "environment": {"PYTHONPATH": path},
        "start_timeout_s": 120.0,
        "timeout_s": 10.0,
        **options,
    }


def install(folder: Path) -> None:
    """Install the small model for servers with options from `options_in`."""
    PluginSite(path=folder / "site").install("rn-reflex", PLUGIN, header="")
    (folder / "run").mkdir(mode=0o700)


@functools.cache
def _folder() -> Path:
    held = tempfile.TemporaryDirectory(prefix="rn-backend-openpi-")
    atexit.register(held.cleanup)
    install(Path(held.name))
    return Path(held.name)
