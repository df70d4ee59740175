"""One replica of a model on a Ray cluster; Ray Serve creates it in a process of its own."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path

from rn_backend_openpi.conversation import Conversation, PolicyRequest, answered, told_of
from rn_backend_openpi.model_server import SharedModelServer
from rn_backend_openpi.options import ModelOptions
from rn_backend_openpi.wire import pack
from roboneuron import RoboNeuronError

_MOST_ROBOTS = 256
"""Number of robots whose chunk contexts are kept; the one that asked longest ago is forgotten."""


class PolicyReplica:
    """Loads the model and answers requests of any robot, several at once.

    Args:
        options: those of the model that are set.

    Raises:
        RoboNeuronError: the model cannot be loaded; Ray Serve reports it.
    """

    def __init__(self, options: Mapping[str, object]) -> None:
        self._robots: OrderedDict[str, Conversation] = OrderedDict()
        # it opens no socket: the requests come by Ray
        self._served = SharedModelServer(
            ModelOptions.model_validate(options), Path(os.devnull), None
        )
        self._served.load()

    async def first(self, number: int) -> bytes:
        """The first message to a robot, whose first request has the number after this one."""
        return pack(self._served.first(number))

    async def ask(self, robot: str, number: int, data: bytes | str) -> bytes | str:
        """Answer one message of a robot.

        Args:
            robot: name of its connection.
            number: that the message must have.
            data: the message.

        Returns:
            The answer, or the text of an error after which the robot is disconnected.
        """
        conversation = self._robots.pop(robot, None) or Conversation(self._served)
        self._robots[robot] = conversation
        if len(self._robots) > _MOST_ROBOTS:
            self._robots.popitem(last=False)
        conversation.expect(number)
        try:
            read = await conversation.read(data)
            if isinstance(read, PolicyRequest):
                read = await answered(conversation, read)
            return pack(read)
        except RoboNeuronError as error:
            return told_of(error)

    def check_health(self) -> None:
        """Raise RuntimeError if the model's thread has ended; Ray Serve restarts the replica."""
        if not self._served.is_alive:
            raise RuntimeError("the model's thread has ended")

    def __del__(self) -> None:
        self._served.close()
