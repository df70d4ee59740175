"""Faults before an episode are recorded as its scene requires, also on a busy machine."""

from __future__ import annotations

import asyncio

import pytest

from rn_eval.agents.cell import wait_for_incident
from rn_eval.agents.client import ToolAnswer
from rn_eval.agents.task import InjectedFault
from roboneuron import NotReadyError

KILLED = InjectedFault(module="perception", kind="kill")
FROZEN = InjectedFault(module="perception", kind="freeze")
STALLED = {"id": "1", "module": "perception", "what": "stalled"}
OTHER = {"id": "2", "module": "inference", "what": "exited"}
RESTART = {"id": "3", "module": "inference", "what": "restart"}
ENDED = {"id": "4", "module": "perception", "what": "exited"}
AFTERWARDS = {"id": "5", "module": "inference", "what": "failing"}


class Recorded:
    """Answers list_incidents with the next list of a script, and then always the last one."""

    def __init__(self, *lists):
        self.left = list(lists)

    async def must(self, tool, /, **arguments):
        found = self.left.pop(0) if len(self.left) > 1 else self.left[0]
        return ToolAnswer(ok=True, data={"incidents": found})


def wait(tools: Recorded, fault: InjectedFault, within_s: float = 5.0) -> None:
    asyncio.run(wait_for_incident(tools, fault, {"1", "2"}, within_s))


def test_a_stall_before_the_kill_is_not_the_kill():
    """The perfect agent answered as list_incidents did, and was judged wrong: the scene's server
    had been shut down before it recorded the kill.
    """
    before = [RESTART, OTHER, STALLED]
    tools = Recorded(before, before, [ENDED, *before])
    wait(tools, KILLED)
    assert tools.left == [[ENDED, *before]]


def test_a_stall_after_the_kill_is_not_the_kill_either():
    with pytest.raises(NotReadyError, match="no incident of perception"):
        wait(Recorded([{**STALLED, "id": "9"}, OTHER]), KILLED, 0.0)


@pytest.mark.parametrize("word", ["silent", "stuck", "stalled"])
def test_a_suspended_module_is_noticed_under_each_of_its_words(word):
    wait(Recorded([{"id": "9", "module": "perception", "what": word}, OTHER]), FROZEN, 0.0)


def test_a_fault_that_follows_makes_it_another_scene():
    with pytest.raises(
        NotReadyError, match="after breaking perception is not the scene's: inference is failing"
    ):
        wait(Recorded([AFTERWARDS, ENDED, OTHER]), KILLED)
