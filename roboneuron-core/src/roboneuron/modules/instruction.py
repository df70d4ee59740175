"""The instruction of an inference module: a ROS parameter, so that it changes without a restart."""

from __future__ import annotations

from collections.abc import Callable

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from roboneuron.modules.module import ModuleNode
from roboneuron.modules.settings import INSTRUCTION_PARAMETER

MAX_INSTRUCTION_LENGTH = 1000


class Instruction:
    """What to do now, how often that was changed, and how many actions it has led to.

    Attributes:
        text: empty when there is nothing to do.
        count: changes since the start; who remembers it notices the next change.
        is_new: the backend has not been reset for it yet.
    """

    def __init__(self, node: ModuleNode, text: str, on_change: Callable[[], None]) -> None:
        """Args:
        node: gets the parameter.
        text: the first one.
        on_change: called after each change, on the executor's thread.
        """
        self._status = node.status
        self._on_change = on_change
        self.text = ""
        self.count = 0
        self.is_new = True
        self._actions = 0
        node.add_on_set_parameters_callback(self._check)
        node.resources.callback(node.remove_on_set_parameters_callback, self._check)
        node.add_post_set_parameters_callback(self._take)
        node.resources.callback(node.remove_post_set_parameters_callback, self._take)
        node.declare_parameter(INSTRUCTION_PARAMETER, text)
        node.resources.callback(node.undeclare_parameter, INSTRUCTION_PARAMETER)

    def restart(self) -> None:
        """Begin with the same instruction again."""
        self._actions = 0
        self.is_new = True
        self._status.set(actions_for_instruction=0)

    def note_action(self) -> None:
        """Count one published action."""
        self._actions += 1
        self._status.set(actions_for_instruction=self._actions)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        reason = next((refused for p in parameters if p.name == INSTRUCTION_PARAMETER and (refused := _refusal(p))), "")
        return SetParametersResult(successful=not reason, reason=reason)

    def _take(self, parameters: list[Parameter]) -> None:
        """Begin with a new instruction; an old failure no longer counts."""
        for parameter in parameters:
            if parameter.name != INSTRUCTION_PARAMETER:
                continue
            self.text = str(parameter.value).strip()
            self.count += 1
            self.restart()
            self._on_change()
            self._status.clear_error()
            self._status.set(instruction=self.text, instruction_count=self.count)
            self._status.changed.set()


def _refusal(parameter: Parameter) -> str:
    if parameter.type_ is not Parameter.Type.STRING:
        return "instruction must be a string"
    if len(parameter.value) > MAX_INSTRUCTION_LENGTH:
        return f"instruction is {len(parameter.value)} characters long, at most {MAX_INSTRUCTION_LENGTH}"
    return ""
