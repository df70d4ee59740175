"""Tools start_all and list_models."""

from __future__ import annotations

from pydantic import Field

from rn_standard.tasks.starting import ParallelStart, requests_for
from roboneuron import (
    Arguments,
    BackendSpec,
    CallContext,
    Host,
    NoArguments,
    Result,
    Tool,
)
from roboneuron.feature import ModuleKind, Registry
from roboneuron.modules.inference.instruction_text import InstructionText
from roboneuron.selection.feature import why_not_started
from roboneuron.selection.options import NamedModelOptions
from roboneuron.selection.requests import StartChosenInference
from roboneuron.tools.loop.results import ModuleSummary


class StartAll(Arguments):
    """Arguments of start_all."""

    instruction: InstructionText | None = Field(
        default=None,
        description='What to do at once, such as "pick up the red cube"; without it nothing moves '
        "yet.",
    )
    model: str | None = Field(
        default=None,
        description="Name of a model in the configuration; the configured policy when omitted.",
    )


class StartAllResult(Result):
    """Result of start_all: every configured module is running and has passed its readiness
    check.
    """

    started: list[ModuleSummary]
    already: list[ModuleKind] = Field(description="ran before")
    ready_after_s: dict[str, float] = Field(description="from the call to the proof of each module")
    took_s: float


class ModelInfo(Result):
    """One model of the configuration."""

    name: str = Field(description="for start_inference, switch_inference and start_all")
    summary: str
    backend: str
    checkpoint: str | None = Field(default=None, description="directory of its files")
    runtime: str | None = None
    preset: str | None = None
    host: str | None = Field(default=None, description="machine that it runs on; this one if none")
    installed: bool = Field(description="everything that it names is installed and its files exist")
    problem: str = Field(default="", description="why it cannot be used")
    running: bool


class Models(Result):
    """Models that can be chosen by name."""

    models: list[ModelInfo]


def start_all_tool(host: Host) -> Tool[StartAll]:
    """start_all."""

    async def handler(arguments: StartAll, context: CallContext) -> StartAllResult:
        model = (
            None
            if arguments.model is None
            else StartChosenInference(model=arguments.model, options={})
        )
        requests = requests_for(arguments.instruction, model)
        start = ParallelStart(host.loop, host.modules, requests, context.role)
        done = await context.run(start.run, on_cancel=start.cancel)
        return StartAllResult(
            started=[ModuleSummary.short_of(view) for view in done.views],
            already=list(done.already),
            ready_after_s={kind: round(took_s, 3) for kind, took_s in sorted(done.took_s.items())},
            took_s=round(done.total_s, 3),
        )

    first = ""
    if host.loop.robot_facts.kind == "simulated":
        first = "; its start sets arm and table as at first"
    return Tool(
        name="start_all",
        title="Start everything",
        description="Start everything that is configured and does not run yet: robot, cameras, "
        f"controller and policy, in parallel. The robot is the {host.loop.robot_facts}{first}. "
        "Returns "
        "when everything works; "
        "if something fails, "
        "what this call started is stopped again. Then call run_task.",
        arguments=StartAll,
        result=StartAllResult,
        handler=handler,
        open_world=True,
    )


def list_models_tool(host: Host) -> Tool[NoArguments]:
    """list_models."""

    async def handler(_: NoArguments, context: CallContext) -> Models:
        view = host.modules.view("inference")
        running = (
            view.plan.names.get("model")
            if view.plan is not None and view.phase == "running"
            else None
        )
        return await context.run(
            lambda _: Models(
                models=[
                    _info(name, model, host, name == running)
                    for name, model in NamedModelOptions.all_of(host.config).items()
                ]
            )
        )

    return Tool(
        name="list_models",
        title="Models by name",
        description="Policies that the configuration names, for `model` of start_inference, "
        "switch_inference and "
        "start_all.",
        arguments=NoArguments,
        result=Models,
        handler=handler,
        read_only=True,
        idempotent=True,
    )


def _info(name: str, model: NamedModelOptions, host: Host, running: bool) -> ModelInfo:
    problem = why_not_started(name, host)
    return ModelInfo(
        name=name,
        summary=model.summary or _summary(host.registry, model.backend),
        backend=model.backend,
        checkpoint=model.checkpoint,
        runtime=model.runtime,
        preset=model.preset,
        host=model.host,
        installed=not problem,
        problem=problem,
        running=running,
    )


def _summary(registry: Registry, backend: str) -> str:
    spec = registry.specs(BackendSpec).get(backend)
    return "" if spec is None else spec.summary
