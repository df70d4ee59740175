"""The backend's contract case: RoboNeuron's own server with a small model, in a thread."""

from __future__ import annotations

import asyncio
import atexit
import functools
import ssl
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import numpy as np

from rn_backend_openpi.batching import Answer
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.options import OpenpiOptions
from rn_backend_openpi.plugin import BACKEND
from rn_backend_openpi.server import LOOPBACK, OpenpiServer, run_server
from rn_backend_openpi.serving import Model, ServedPolicy
from rn_testing import BackendCase
from roboneuron import EE_DELTA, ActionChunk, BackendSpec, ControlSpace, Observation

_START_S = 30.0
REFLEX = BackendSpec(
    name="reflex",
    summary="One layer over the mean colours of the picture.",
    target=f"{__name__}:Reflex",
    needs_state=True,
)
"""Descriptor of the small model."""


class Reflex:
    """One layer over the mean colours of the picture and the state; see `Model`.

    Args:
        space: control space of its rows.
        step_s: time between two rows [s].
    """

    most = 8

    def __init__(self, space: ControlSpace = EE_DELTA, step_s: float = 0.1) -> None:
        self._space, self._step_s = space, step_s
        self._weights = np.random.default_rng(0).standard_normal((8, 4 * space.size))

    def load(self) -> None:
        """Nothing to load."""

    def answer(self, observations: Sequence[Observation]) -> Sequence[Answer]:
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

    def close(self) -> None:
        """Nothing to release."""


@contextmanager
def serving(
    options: OpenpiOptions,
    model: Model,
    spec: BackendSpec = REFLEX,
    *,
    space: ControlSpace = EE_DELTA,
    key: str | None = None,
    tls: ssl.SSLContext | None = None,
    port: int = 0,
) -> Iterator[str]:
    """Run a server in a thread while the block runs; yields its URL.

    Args:
        options: of the interface and of the server.
        model: the served model.
        spec: its descriptor.
        space: control space of its rows.
        key: key that clients must send.
        tls: TLS context of the server.
        port: 0 for any free one.
    """
    policy = ServedPolicy(model, spec, layout_of(options, space), space, options)
    policy.load()
    ports: list[int] = []
    is_open = threading.Event()
    loop = asyncio.new_event_loop()
    until = asyncio.Event()

    def tell(port: int) -> None:
        ports.append(port)
        is_open.set()

    async def serve() -> None:
        # one thread from the start: the contract kit counts threads that a client leaves behind
        loop.set_default_executor(ThreadPoolExecutor(max_workers=1))
        await asyncio.to_thread(int)
        server = OpenpiServer(policy, options.server, key)
        await run_server(server, (LOOPBACK, port), tls, tell, until)

    def run() -> None:
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(serve())

    thread = threading.Thread(target=run, name="openpi-server", daemon=True)
    thread.start()
    try:
        if not is_open.wait(_START_S):
            raise TimeoutError("the server does not listen")
        yield f"{'ws' if tls is None else 'wss'}://{LOOPBACK}:{ports[0]}"
    finally:
        loop.call_soon_threadsafe(until.set)
        thread.join(_START_S)
        policy.close()


def openpi_case() -> BackendCase:
    """`openpi` with a server that runs until the process exits."""
    return BackendCase(spec=BACKEND, options={"profile": "roboneuron", "url": _url()})


@functools.cache
def _url() -> str:
    stack = ExitStack()
    atexit.register(stack.close)
    return stack.enter_context(serving(OpenpiOptions(profile="roboneuron"), Reflex()))
