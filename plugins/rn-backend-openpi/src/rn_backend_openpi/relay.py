"""Bytes between a robot and the server of its model, handed on in both directions, unparsed."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from pathlib import Path

from websockets import frames
from websockets.asyncio.client import unix_connect
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.protocol import State

from rn_backend_openpi.description import FAILED, LOADING, PROTOCOL
from rn_backend_openpi.listener import CountedConnection, PipedClient, send
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import MOST_BYTES, pack

log = logging.getLogger(__name__)
_REACH_S = 2.0


class _Flow:
    """Times between the requests and the answers of a connection, by the flow of their bytes.

    Args:
        note: called with the time from the end of a request to the begin of its answer [s].
    """

    def __init__(self, note: Callable[[float], None]) -> None:
        self._note, self._asked_s = note, 0.0
        self.is_asked = False

    def ask(self, part: bytes) -> None:
        """Note a part of a request; the closing frame with which a client answers the server's is
        none.
        """
        if _is_closing_frame(part):
            return
        self.is_asked, self._asked_s = True, time.monotonic()

    def answer(self, part: bytes) -> None:
        """Note a part of an answer."""
        if self.is_asked:
            self._note(time.monotonic() - self._asked_s)
        self.is_asked = False


def _is_closing_frame(part: bytes) -> bool:
    """True for one whole closing frame of a client. Source: RFC 6455, 5.2 and 5.5.1."""
    mask_size = 4
    return (
        len(part) >= 2
        and part[0] == 0x80 | frames.OP_CLOSE
        and len(part) == 2 + mask_size + (part[1] & 0x7F)
    )


async def reach(path: Path) -> PipedClient:
    """A connection to the server at a local socket. Raises OSError or InvalidHandshake."""
    reached = await unix_connect(
        str(path),
        "ws://localhost/",
        create_connection=PipedClient,
        compression=None,
        max_size=MOST_BYTES,
        ping_interval=None,
        open_timeout=_REACH_S,
        close_timeout=_REACH_S,
    )
    assert isinstance(reached, PipedClient)
    return reached


async def turn_away(robot: ServerConnection, failure: Document | None) -> None:
    """Tell a robot that its model is loading or has failed, in place of its server's first
    message, and disconnect it.
    """
    state = LOADING if failure is None else FAILED
    own = {"protocol": PROTOCOL, "state": state, "pid": 0, **(failure or {})}
    await send(robot, pack({RESERVED: own}))
    await robot.close(CloseCode.TRY_AGAIN_LATER, "the model is not ready")


async def carry(
    robot: CountedConnection, there: PipedClient, name: str, note: Callable[[float], None]
) -> int:
    """Hand on bytes until one of both disconnects; returns the number of lost observations.

    Args:
        robot: its connection.
        there: connection to the server of its model.
        name: name of the model.
        note: called with the time of each answer [s].
    """
    flow, has_died = _Flow(note), True
    try:
        welcome = await there.recv()
    except ConnectionClosed:
        pass
    else:
        if robot.is_early:  # it would be computed in part
            log.warning("%s does not wait for the first message.", robot.remote_address)
            robot.transport.abort()
            return 0
        # from before the robot hears anything: nothing that it sends is parsed here
        robot.other, robot.passed = there, flow.ask
        there.other, there.passed = robot, flow.answer
        await send(robot, welcome)
        ends = [asyncio.create_task(one.wait_closed()) for one in (robot, there)]
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        robot.other = there.other = None
        for end in ends:
            end.cancel()
        has_died = flow.is_asked
    if there.state is not State.CLOSED:
        return 0
    if has_died:
        told = f"The model {name!r} has died; the server restarts it."
        await robot.close(CloseCode.SERVICE_RESTART, told)
    else:  # it has said why in a frame of its own
        robot.transport.close()
    return int(flow.is_asked)
