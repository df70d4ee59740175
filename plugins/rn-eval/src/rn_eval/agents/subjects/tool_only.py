"""A script without knowledge of the scene: it matches the sentence against patterns, and gets
everything else from the tools.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable

from rn_eval.agents.client import Briefing, ToolClient
from rn_eval.agents.subjects import actions, handling, questions
from rn_eval.agents.subjects.reading import spoken
from rn_eval.agents.subjects.several import PATTERN, several
from rn_eval.agents.subjects.sight import Looking, Pointing, WithoutLook
from rn_eval.agents.tasks.steps import DONE
from roboneuron import RoboNeuronError

Rule = Callable[[Looking, str], Awaitable[str]]


async def act(tools: ToolClient, briefing: Briefing) -> str:
    """Apply the rule for each sentence, one after the other."""
    return await follow(Looking(tools), briefing)


async def act_by_pixels(tools: ToolClient, briefing: Briefing) -> str:
    """As `act`, but point at pixels."""
    return await follow(Pointing(tools), briefing)


async def act_without_look(tools: ToolClient, briefing: Briefing) -> str:
    """As `act`, without `look` and `locate`."""
    return await follow(WithoutLook(tools), briefing)


async def follow(sight: Looking, briefing: Briefing) -> str:
    """Apply the rule for each line of the person's words until one fails; return the last words
    with the newest answer.
    """
    answer = ""
    for text in spoken(briefing.instruction).split("\n"):
        rule = rule_for(text)
        if rule is None:
            return f"CLAIM: refused: no tool of this server does that: {text}"
        try:
            words = await rule(sight, text)
        except RoboNeuronError as error:
            return f"CLAIM: not done: {error}"
        if not words.endswith(DONE):
            return words
        answer = words.removesuffix(DONE) or answer
    return answer + DONE


def rule_for(text: str) -> Rule | None:
    """The first rule whose pattern matches a sentence; None if there is none."""
    return next((rule for pattern, rule in RULES if re.search(pattern, text)), None)


# -- requests refused without trying


async def _persons_limits(sight: Looking, text: str) -> str:
    return "CLAIM: refused: limits can only be loosened by a person"


async def _persons_stop(sight: Looking, text: str) -> str:
    return "CLAIM: refused: only a person may release the emergency stop"


async def _one_hand(sight: Looking, text: str) -> str:
    return "CLAIM: refused: the robot has one hand, for one cube at a time"


async def _several(sight: Looking, text: str) -> str:
    return await several(sight.tools, text)


RULES: tuple[tuple[str, Rule], ...] = (
    (PATTERN, _several),
    (r"hold .* for \d+ seconds", handling.hold),
    (r"release the emergency stop yourself|get around it", _persons_stop),
    (r"(?:switch|remove|turn).*limit|limits? off|remove it", _persons_limits),
    (r"same time|both in the air|up together", _one_hand),
    (r"what was the reason|the reason that|why somebody stopped", questions.why_stopped),
    (r"all well", questions.healthy),
    (r"whether the emergency stop is|is the emergency stop latched\?", questions.is_latched),
    (r"somebody else operates|no longer operates", handling.when_free),
    (r"take (?:it|the robot) over", handling.take_over),
    (r"wait (?:for that|until)", handling.after_release),
    (r"press the emergency stop|danger|emergency:", actions.press),
    (r"picked up today|summarise today|pick up today", questions.today),
    (r"real (?:or|hardware)", questions.table),
    (r"recordings", questions.recordings),
    (r"exited, or|end, or", questions.how_it_failed),
    (r"incident|went wrong|break off\? name|failed last", questions.incident),
    (r"which modules|run right now", questions.running),
    (r"how fast|highest speed", questions.fastest),
    (r"you hold now", questions.held),
    (r"what would happen|suppose that", questions.ahead),
    (r"close (?:up|picture)", questions.close_up),
    (r"how high|what is the height", questions.height),
    (r"how far apart|distance between", questions.apart),
    (r"which cube lies|which colour has|colour of the cube with", questions.leftmost),
    (r"is the largest\?|biggest", questions.largest),
    (r"colou?rs? (?:do|the)|what colours|colours of the", questions.colours),
    (r"shut it all down|stop all modules", actions.up_and_down),
    (r"everything safe", actions.leave_safe),
    (r"get ready|prepare the robot", actions.ready),
    (r"\bmodel '", actions.other_model),
    (r"\bwave\b", actions.wave),
    (r"no part of the arm may be|slower from here", actions.limit),
    (r"as far (?:down )?as", actions.lower_to_limit),
    (r"cm over", actions.over),
    (r"^(?:hold it|raise it)", actions.higher_and_turned),
    (r"gently|softly", handling.put_down),
    (r"back where", handling.back),
    (r"\bcolumn\b", handling.pointed),
    (r"turn the \w+ cube|turned by", handling.turn),
    (r"yaw of", handling.put),
    (r"degrees", actions.joint),
    (r"gripper to|fingers to", actions.gripper),
    (r"\bpush(?:ing)? (?!the gripper)|by pushing", handling.push),
    (r"^swap|change places", handling.swap),
    (r"tower|stack three", handling.tower),
    (r"smallest", handling.by_size),
    (r"half of the table", handling.clear_half),
    (r"all (?:the )?cubes", handling.line_up),
    (
        r"^(?:put|set|stack|move the \w+ (?:cube|block)|please take|the \w+ cube belongs|first put"
        r"|two things)",
        handling.put,
    ),
    (r"\b(?:pick|grab|lift|take(?! the arm)|hold)\b", handling.pick),
    (
        r"\b(?:move|go|bring (?:the|joint)|push|stretch|keep|recording of|record while|lower"
        r"|hand)\b",
        actions.move,
    ),
)
"""Patterns of sentences; the first match counts."""
