"""The instruction of an inference module: a ROS parameter, so that it can change without a
restart.
"""

from __future__ import annotations

from collections.abc import Callable

from roboneuron.errors import InvalidInputError
from roboneuron.modules import settings
from roboneuron.modules.inference.instruction_text import instruction_problem
from roboneuron.modules.module_host import ModuleHost


class Instruction:
    """The present instruction, its number of changes, and the number of resulting actions.

    Attributes:
        text: empty for none.
        count: changes since the start, by which a change is detected.
        is_new: the backend has not been reset for it yet.
    """

    def __init__(self, node: ModuleHost, text: str, on_change: Callable[[], None]) -> None:
        """Args:
        node: gets the parameter.
        text: the initial instruction.
        on_change: called after each change, on the executor's thread.

        Raises:
            InvalidInputError: the initial instruction is invalid.
        """
        self._node = node
        self._status = node.status
        self._on_change = on_change
        self.text = ""
        self.count = 0
        self.is_new = True
        self._actions = 0
        if reason := instruction_problem(text):
            raise InvalidInputError(reason)
        node.resources.callback(
            node.add_parameter(settings.INSTRUCTION_PARAMETER, text, self._take, self._refusal)
        )
        # If a stop came while the backend was loaded, the instruction of the start is void: motion
        # needs a new one.
        self._take("" if node.needs_start else text)

    def restart(self) -> None:
        """Restart the same instruction."""
        self._actions = 0
        self.is_new = True
        self._status.set(actions_for_instruction=0)

    def forget(self) -> None:
        """Discard the instruction after a stop: motion needs a new one."""
        self._take("")

    def note_action(self) -> None:
        """Count one published action."""
        self._actions += 1
        self._status.set(actions_for_instruction=self._actions)

    def _take(self, text: str) -> None:
        """Begin a new instruction, or none; an earlier error is cleared.

        An instruction is a request for motion, so it also ends `needs_start` of this module. That
        of robot and control is ended by the server, see `MotionStarts.permit`.
        """
        self.text = text.strip()
        if self.text:
            self._node.needs_start = ""
            self._status.set(needs_start="")
        self.count += 1
        self.restart()
        self._on_change()
        self._status.clear_error()
        self._status.set(instruction=self.text, instruction_count=self.count)
        self._status.changed.set()

    def _refusal(self, text: str) -> str:
        """Reason to refuse an instruction; empty if it is accepted. An empty instruction
        always is.
        """
        if text.strip() and self._node.stopped:
            return "the emergency stop is latched"
        return instruction_problem(text)
