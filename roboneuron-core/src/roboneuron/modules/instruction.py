"""The instruction of an inference module: a ROS parameter, so that it changes without a restart."""

from __future__ import annotations

from rclpy.parameter import Parameter

from roboneuron.modules.status import ModuleStatus

MAX_INSTRUCTION_LENGTH = 1000


class Instruction:
    """What to do now, how often that was changed, and how many actions it has led to.

    Attributes:
        text: empty when there is nothing to do.
        count: changes since the start; who remembers it notices the next change.
        is_new: the backend has not been reset for it yet.
    """

    def __init__(self, status: ModuleStatus) -> None:
        self._status = status
        self.text = ""
        self.count = 0
        self.is_new = True
        self._actions = 0

    def check(self, parameter: Parameter) -> str:
        """Why the parameter's value cannot be an instruction; empty when it can."""
        if parameter.type_ is not Parameter.Type.STRING:
            return "instruction must be a string"
        if len(parameter.value) > MAX_INSTRUCTION_LENGTH:
            return f"instruction is {len(parameter.value)} characters long, at most {MAX_INSTRUCTION_LENGTH}"
        return ""

    def set(self, text: str) -> None:
        """Begin with a new instruction; an old failure no longer counts."""
        self.text = text.strip()
        self.count += 1
        self.restart()
        self._status.clear_error()
        self._status.set(instruction=self.text)
        self._status.set(instruction_count=self.count)
        self._status.changed.set()

    def restart(self) -> None:
        """Begin with the same instruction again."""
        self._actions = 0
        self.is_new = True
        self._status.set(actions_for_instruction=0)

    def note_action(self) -> None:
        """Count one published action."""
        self._actions += 1
        self._status.set(actions_for_instruction=self._actions)
