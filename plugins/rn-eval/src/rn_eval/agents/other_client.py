"""A second person's client of the same HTTP server, which operates the robot first."""

from __future__ import annotations

import anyio

from rn_eval.agents.client import ToolClient, connected_to
from roboneuron import NotReadyError

_WITHIN_S = 90.0


def begin_to_operate(url: str, token: str) -> None:
    """Start the robot as another client, which becomes the operator, and disconnect without
    releasing the lease, which then expires.

    Raises:
        NotReadyError: the robot could not be started.
    """
    anyio.run(_start_robot, url, token)


async def _start_robot(url: str, token: str) -> None:
    with anyio.move_on_after(_WITHIN_S):
        async with connected_to(url, token) as client:
            await ToolClient(client).must("start_robot")
            return
    raise NotReadyError(f"The other client could not start the robot within {_WITHIN_S:g} s.")
