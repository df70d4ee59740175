"""A backend as a model server of vla-eval 0.8: `roboneuron eval serve`."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from importlib.metadata import version

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from rn_eval import bridge, wire
from rn_eval.policy import EpisodePolicy
from roboneuron import RoboNeuronError


@dataclass(slots=True)
class ClientSession:
    """State of one client: the unsent rows of its last chunk."""

    rows: deque[NDArray[np.float64]] = field(default_factory=deque)


class EvalModelServer:
    """Answers each observation with one action; a chunk is used up before the next prediction.

    All clients share the policy, one prediction at a time. `reset` is called when a client's
    episode begins, so several concurrent clients need a backend without state between predictions.

    Args:
        policy: a loaded policy.
        name: name of the backend, for HELLO.
        roles: cameras that the backend needs.
        needs_state: the backend reads the state.
    """

    def __init__(
        self, policy: EpisodePolicy, *, name: str, roles: tuple[str, ...], needs_state: bool
    ) -> None:
        self._policy, self._name, self._roles, self._needs_state = policy, name, roles, needs_state
        self._using = asyncio.Lock()

    async def handle(self, connection: ServerConnection) -> None:
        """Serve one client until it disconnects."""
        session = ClientSession()
        try:
            async for data in connection:
                reply = await self._answer(data, session)
                if reply is not None:
                    await connection.send(wire.pack(reply))
        except ConnectionClosed:
            return

    async def _answer(self, data: object, session: ClientSession) -> wire.WireMessage | None:
        seq = 0
        try:
            message = await asyncio.to_thread(wire.unpack, data)
            seq = message.seq
            if message.kind == "hello":
                return wire.WireMessage("hello", self._hello(), seq)
            if message.kind == "episode_start":
                session.rows.clear()
                async with self._using:
                    await asyncio.to_thread(self._policy.reset)
            elif message.kind == "observation":
                return wire.WireMessage(
                    "action", {"actions": await self._act(message.payload, session)}, seq
                )
            elif message.kind == "episode_end":
                session.rows.clear()
        except RoboNeuronError as error:
            return wire.WireMessage("error", {"error": f"{type(error).__name__}: {error}"}, seq)
        return None

    def _hello(self) -> dict[str, object]:
        told = bridge.specs(self._roles, needs_state=self._needs_state)
        return {
            "harness_version": f"roboneuron {version('rn-eval')}",
            "protocol_version": wire.PROTOCOL_VERSION,
            "model_server": self._name,
            "capabilities": {},
            **told,
        }

    async def _act(
        self, payload: Mapping[str, object], session: ClientSession
    ) -> NDArray[np.float32]:
        if not session.rows:
            observation = bridge.to_observation(payload, self._roles, needs_state=self._needs_state)
            async with self._using:
                chunk = await asyncio.to_thread(self._policy.predict, observation)
            session.rows.extend(chunk.actions)
        return bridge.to_action(session.rows.popleft())


def _health(connection: ServerConnection, request: Request) -> Response | None:
    if request.path != "/health":
        return None
    response = connection.respond(HTTPStatus.OK, '{"status": "ok"}\n')
    del response.headers["Content-Type"]
    response.headers["Content-Type"] = "application/json"
    return response


async def open_server(server: EvalModelServer, host: str, port: int) -> Server:
    """Listen; from then on GET /health answers."""
    return await serve(
        server.handle,
        host,
        port,
        process_request=_health,
        compression=None,
        max_size=wire.MOST_MESSAGE_BYTES,
        ping_interval=None,  # vla-eval's client sends no pings either; predictions may be slow
    )


async def run_server(
    server: EvalModelServer, host: str, port: int, listening: Callable[[int], None]
) -> None:
    """Serve until cancelled; `listening` is called with the port."""
    async with await open_server(server, host, port) as opened:
        listening(next(iter(opened.sockets)).getsockname()[1])
        await opened.serve_forever()
