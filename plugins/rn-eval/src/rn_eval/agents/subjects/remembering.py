"""Extension of `tool_only` that reads the task history and repeats what succeeded."""

from __future__ import annotations

import re

from rn_eval.agents.client import Briefing, ToolClient
from rn_eval.agents.subjects import tool_only
from rn_eval.agents.subjects.reading import named_colours, spoken
from rn_eval.agents.tasks.steps import DONE, lift_with
from roboneuron import RoboNeuronError

_COMMON = frozenset(
    {"a", "again", "and", "as", "at", "before", "belongs", "by", "configured", "cube", "did", "do"}
    | {"failed", "has", "in", "is", "it", "last", "lift", "more", "of", "once", "one", "pick"}
    | {"policy", "same", "that", "the", "this", "time", "to", "up", "what", "with", "worked", "you"}
)
"""Words that do not help to identify a past task."""


async def act(tools: ToolClient, briefing: Briefing) -> str:
    """Repeat a past success with its words and its policy; without one, act as `tool_only`."""
    text = spoken(briefing.instruction)
    try:
        past = await _succeeded(tools, text)
        if past is None:
            return await tool_only.act(tools, briefing)
        colours = named_colours(str(past.get("instruction")))
        model = past.get("model")
        backend = str(model.get("backend", "")) if isinstance(model, dict) else ""
        await lift_with(tools, backend, colours[0])
    except RoboNeuronError as error:
        return f"CLAIM: not done: {error}"
    return DONE


async def _succeeded(tools: ToolClient, text: str) -> dict[str, object] | None:
    """The newest successful past lifting task that contains all significant words of a sentence
    that asks to lift a cube; None otherwise.
    """
    rule = tool_only.rule_for(text)
    wanted = set(re.findall(r"\w+", text)) - _COMMON
    if rule is not tool_only.pick or not wanted:
        return None
    for past in (await tools.must("list_tasks", entries=50)).data["tasks"]:  # type: ignore[attr-defined]
        words = set(re.findall(r"\w+", str(past["instruction"]).lower()))
        if past["outcome"] == "succeeded" and wanted & words and named_colours(" ".join(words)):
            return dict(past)
    return None
