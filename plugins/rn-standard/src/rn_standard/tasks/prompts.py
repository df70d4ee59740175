"""Prompts for common jobs, for clients that offer them to users."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mcp import types
from mcp.server import Server
from mcp.shared.exceptions import MCPError


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskPrompt:
    """A prompt.

    Attributes:
        title: for users.
        description: one line.
        text: with `{name}` as the placeholder of an argument.
        arguments: description by name; all are required.
    """

    title: str
    description: str
    text: str
    arguments: Mapping[str, str] = field(default_factory=dict)


PROMPTS: Mapping[str, TaskPrompt] = {
    "bring_up": TaskPrompt(
        title="Bring the robot up",
        description="Start everything and check that it works.",
        text="Call get_status. If the emergency stop is latched, tell me why and stop there. "
        "Otherwise call start_all, "
        "look through the cameras with get_camera_image, and tell me what you see and whether "
        "every module is ok.",
    ),
    "pick_up": TaskPrompt(
        title="Pick something up",
        description="Pick up an object of a colour and say whether it worked.",
        arguments={"colour": "red, orange, yellow, green, blue or purple"},
        text="Make sure that everything runs (start_all). Then call run_task with the instruction "
        '"pick up the {colour} cube", until "lifted" and max_attempts 3. '
        "Tell me the outcome and the reason. If the outcome is unclear, judge by the images from "
        "before and after, and "
        "say that it is your judgement.",
    ),
    "put_away": TaskPrompt(
        title="Put the robot away",
        description="End what runs, go to a safe posture, stop everything.",
        text="Call stop_motion if anything moves. If move_to knows home, go there; make sure "
        "before, by a camera "
        "image, that nothing is in the way. Then call stop_all and tell me what was stopped.",
    ),
    "what_is_wrong": TaskPrompt(
        title="Find out what is wrong",
        description="Look at status, incidents and logs, and explain.",
        text="Call get_status and read roboneuron://events/incidents. For each module that is not "
        "ok call get_logs. "
        "Tell me the most likely cause in two sentences, what you are sure of and what not, and "
        "what a person should "
        "do. Start, stop or move nothing.",
    ),
    "compare_models": TaskPrompt(
        title="Compare models",
        description="Let each configured model try the same task.",
        arguments={
            "instruction": "what each model is to do",
            "until": "predicate of run_task, as JSON",
        },
        text="Call list_models. For each installed one: switch_inference to it (or "
        "start_inference, if none runs), "
        "then run_task with the instruction {instruction!r}, max_attempts 1 and until {until}. "
        "Between two models let "
        "me put the scene back, and wait for my word. Tell me outcome, reason and time of each in "
        "a table.",
    ),
}
"""Prompt by name."""


def offer_prompts(server: Server[object]) -> None:
    """Register the handlers of prompts/list and prompts/get; called before the server serves
    clients.
    """

    async def list_prompts(
        _: object, params: types.PaginatedRequestParams
    ) -> types.ListPromptsResult:
        return types.ListPromptsResult(
            prompts=[
                types.Prompt(
                    name=name,
                    title=prompt.title,
                    description=prompt.description,
                    arguments=[
                        types.PromptArgument(name=argument, description=text, required=True)
                        for argument, text in prompt.arguments.items()
                    ],
                )
                for name, prompt in PROMPTS.items()
            ]
        )

    async def get_prompt(_: object, params: types.GetPromptRequestParams) -> types.GetPromptResult:
        return filled(params.name, params.arguments or {})

    server.add_request_handler("prompts/list", types.PaginatedRequestParams, list_prompts)
    server.add_request_handler("prompts/get", types.GetPromptRequestParams, get_prompt)


def filled(name: str, arguments: Mapping[str, str]) -> types.GetPromptResult:
    """Fill in a prompt's arguments. Raises MCPError for an unknown prompt or wrong arguments."""
    prompt = PROMPTS.get(name)
    if prompt is None:
        raise MCPError(
            types.INVALID_PARAMS,
            f"There is no prompt {name[:80]!r}; there are: {', '.join(PROMPTS)}.",
        )
    if set(arguments) != set(prompt.arguments):
        wanted = ", ".join(prompt.arguments) or "no arguments"
        raise MCPError(types.INVALID_PARAMS, f"The prompt {name!r} takes {wanted}.")
    text = types.TextContent(type="text", text=prompt.text.format(**arguments))
    return types.GetPromptResult(
        description=prompt.description, messages=[types.PromptMessage(role="user", content=text)]
    )
