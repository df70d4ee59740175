"""Models of `roboneuron policy serve --engine ray`: replicas on a Ray cluster. Ray Serve places,
restarts, drains and scales them, and chooses the one that answers a request.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection
from websockets.frames import CloseCode

from rn_backend_openpi.description import FAILED, LOADING, READY
from rn_backend_openpi.front import MakeModel
from rn_backend_openpi.listener import send
from rn_backend_openpi.messages import Document, from_error
from rn_backend_openpi.relay import turn_away
from rn_backend_openpi.server_options import RayOptions, ServedModelOptions
from roboneuron import (
    BackendSpec,
    ConfigurationError,
    MissingDependencyError,
    NotReadyError,
)
from roboneuron.command import discover
from roboneuron.feature import Registry

if TYPE_CHECKING:
    from ray.serve.handle import DeploymentHandle

log = logging.getLogger(__name__)
_ROUTER = "ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"
"""Sends the requests of one session to one replica, as long as it lives."""
_LONGEST_S = 60.0
"""Longest time for an answer; the replica ends at the deadline of the request."""
_ATTEMPTS = 2
"""How many replicas one observation may be sent to: an answer changes nothing at a replica."""
_MOST_OPEN = 4
_NUMBER_BITS = 62
_DRAIN_S = 10.0
_HEALTH_S = 1.0
_UP_S, _DOWN_S = 3.0, 60.0
"""Time with too many, too few observations in work before replicas are added, removed."""


@contextmanager
def ray_models(options: RayOptions) -> Iterator[MakeModel]:
    """Join a Ray cluster, or run one on this machine, within the context; yields the constructor of
    models on it.

    Raises:
        MissingDependencyError: Ray Serve is not installed.
        NotReadyError: there is no cluster at the address.
    """
    try:
        import ray  # heavy
        from ray import serve
    except ImportError as error:
        raise MissingDependencyError(
            f"--engine ray needs Ray Serve, which is not installed: {error}.",
            hint='pip install "ray[serve]"',
        ) from error
    is_own = options.address is None
    chosen = (
        {"address": "local", "include_dashboard": False} if is_own else {"address": options.address}
    )
    try:
        ray.init(namespace="roboneuron", log_to_driver=False, **chosen)
    except ConnectionError as error:
        raise NotReadyError(
            f"There is no Ray cluster at {options.address!r}: {error}.",
            hint="Start one with `ray start --head`, or leave `address` under [ray] out.",
        ) from error
    try:
        serve.start(proxy_location="Disabled")
        registry = discover()
        yield lambda name, model, path: RayModel(name, model, path.stem, registry)
    finally:
        if is_own:
            serve.shutdown()  # type: ignore[no-untyped-call]
        ray.shutdown()


class RayModel:
    """The replicas of one model, from `start` to `close`; see `ServedModel`.

    Args:
        name: name of the model.
        options: options of the model.
        application: its name in Ray Serve.
        registry: installed plugins.

    Raises:
        ConfigurationError: its backend is not installed, or it names an interpreter.
    """

    def __init__(
        self, name: str, options: ServedModelOptions, application: str, registry: Registry
    ) -> None:
        if options.python is not None:
            raise ConfigurationError(
                f"[models.{name}] names a `python`; a replica has the interpreter of its Ray node.",
                hint="Start `ray` there with that interpreter, and leave `python` out.",
            )
        self.name = name
        self._options = options
        assert options.backend is not None
        spec = registry.get(BackendSpec, options.backend)
        self._remembers = spec.conditions_on_rows
        self._application = application
        self._handle: DeploymentHandle[Any] | None = None
        self._failure: Document | None = None
        self._lost = 0
        self._deploying = threading.Thread(target=self._deploy, name=f"model {name}", daemon=True)

    @property
    def state(self) -> str:
        """`LOADING`, `READY` or `FAILED`; ready if a replica is."""
        if self._failure is not None:
            return FAILED
        if self._handle is None:
            return LOADING
        return READY if self._replicas().get("RUNNING") else LOADING

    def start(self) -> None:
        """Deploy the replicas; returns at once."""
        self._deploying.start()

    def stop(self) -> None:
        """Nothing to request: `close` ends the replicas."""

    def close(self) -> None:
        """End the replicas after their last answers; idempotent."""
        from ray import serve

        serve.delete(self._application)

    def status(self) -> Document:
        """State, and number of replicas by Ray Serve's states."""
        told: Document = {"state": self.state, "pid": None, "replicas": self._replicas()}
        if self._failure is not None:
            told["failure"] = self._failure["message"]
        return told

    async def relay(self, robot: ServerConnection, note: Callable[[float], None]) -> int:
        """Answer a robot until it disconnects; returns the number of lost observations."""
        handle = self._handle
        if handle is None:
            await turn_away(robot, self._failure)
            return 0
        line = _RobotLine(robot, handle, note, self._remembers)
        await line.run()
        return line.lost

    def _deploy(self) -> None:
        from ray import serve

        from rn_backend_openpi.ray_replica import PolicyReplica

        replicas = serve.deployment(**self._settings())(PolicyReplica)
        application = replicas.bind(self._options.of_the_model().model_dump(exclude_unset=True))
        try:
            self._handle = serve.run(application, name=self._application, route_prefix=None)
        except RuntimeError as error:  # the replicas could not load the model
            log.error("The model %s is not served: %s", self.name, error)
            refusal = NotReadyError(f"No replica of the model {self.name!r} was started: {error}")
            self._failure = from_error(refusal)

    def _settings(self) -> dict[str, Any]:
        own = self._options
        routed = {"request_router_config": {"request_router_class": _ROUTER}}
        return {
            "name": self.name,
            "autoscaling_config": {
                "min_replicas": own.ray.least,
                "initial_replicas": own.ray.least,
                "max_replicas": own.ray.most,
                "target_ongoing_requests": own.most,
                "upscale_delay_s": _UP_S,
                "downscale_delay_s": _DOWN_S,
            },
            "max_ongoing_requests": own.waiting,
            "max_queued_requests": own.waiting,
            "health_check_period_s": _HEALTH_S,
            "health_check_timeout_s": _DRAIN_S,
            "graceful_shutdown_timeout_s": _DRAIN_S,
            "ray_actor_options": {
                "num_cpus": own.ray.cpus,
                "num_gpus": own.ray.gpus,
                "runtime_env": {"env_vars": own.environment},
            },
            **(routed if self._remembers else {}),
        }

    def _replicas(self) -> dict[str, int]:
        """Number of replicas by Ray Serve's states, such as RUNNING."""
        from ray import serve

        found = serve.status().applications.get(self._application)
        deployments = () if found is None else found.deployments.values()
        return {
            str(state): count
            for deployment in deployments
            for state, count in deployment.replica_states.items()
        }


class _RobotLine:
    """The connection of one robot.

    Attributes:
        lost: number of observations without an answer because replicas ended.
    """

    def __init__(
        self,
        robot: ServerConnection,
        handle: DeploymentHandle[Any],
        note: Callable[[float], None],
        remembers: bool,
    ) -> None:
        self._robot, self._handle, self._note = robot, handle, note
        self._name = secrets.token_hex(8)
        self._ask = handle.ask.options(session_id=self._name if remembers else "")
        self._number = secrets.randbits(_NUMBER_BITS)
        self.lost = 0

    async def run(self) -> None:
        """Send the welcome, and answer requests until the robot disconnects."""
        await send(self._robot, await self._handle.first.remote(self._number))
        open_tasks: set[asyncio.Task[None]] = set()
        try:
            async for data in self._robot:
                while len(open_tasks) >= _MOST_OPEN:
                    await asyncio.wait(open_tasks, return_when=asyncio.FIRST_COMPLETED)
                self._number += 1
                task = asyncio.create_task(self._answer(data, self._number))
                open_tasks.add(task)
                task.add_done_callback(open_tasks.discard)
        finally:
            for task in open_tasks:
                task.cancel()

    async def _answer(self, data: str | bytes, number: int) -> None:
        """Answer one request."""
        begun_s = time.monotonic()
        try:
            async with asyncio.timeout(_LONGEST_S):
                told = await self._asked(data, number)
        except TimeoutError:
            return
        if told is None:
            self.lost += 1
            return
        self._note(time.monotonic() - begun_s)
        await send(self._robot, told)
        if isinstance(told, str):
            await self._robot.close(CloseCode.INTERNAL_ERROR, "see the text frame before")

    async def _asked(self, data: str | bytes, number: int) -> str | bytes | None:
        """A replica's answer; None if those that were asked ended."""
        from ray.exceptions import RayError
        from ray.serve.exceptions import RayServeException

        for _ in range(_ATTEMPTS):
            try:
                told: str | bytes = await self._ask.remote(self._name, number, data)
            except (RayError, RayServeException) as error:
                log.warning("A replica gave no answer: %s", str(error).splitlines()[0])
            else:
                return told
        return None
