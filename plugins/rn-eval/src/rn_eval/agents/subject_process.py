"""Runs a shipped or installed agent as a process: `python -m rn_eval.agents.subject_process NAME`.
Its last words go to standard output.
"""

from __future__ import annotations

import sys
from collections.abc import Awaitable, Callable
from typing import cast

import anyio

from rn_eval.agents.client import Briefing, ToolClient, connect
from rn_eval.hooks import AgentSubjectSpec
from roboneuron import RoboNeuronError
from roboneuron.command import discover
from roboneuron.feature import loading

Subject = Callable[[ToolClient, Briefing], Awaitable[str]]
"""An agent: carries out its briefing and returns its last words."""


async def play(subject: Subject, briefing: Briefing) -> str:
    """Run one episode of an agent with the server named in the environment."""
    async with connect() as tools:
        return await subject(tools, briefing)


def main() -> int:
    """Run the agent; status 1 if it fails."""
    try:
        spec = discover().get(AgentSubjectSpec, sys.argv[1])
        target = loading.load_attribute(spec.target, f"`target` of {spec.name!r}")
        subject = cast("Subject", target)
        words = anyio.run(play, subject, Briefing.from_environment())
    except RoboNeuronError as error:
        print(f"CLAIM: not done: {error}")
        return 1
    print(words)
    return 0


if __name__ == "__main__":
    sys.exit(main())
