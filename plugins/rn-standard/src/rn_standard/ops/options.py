"""The section `[ops]` of roboneuron.toml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron import Section
from roboneuron.feature import ModuleKind

Restart = Literal["never", "on_failure"]
Seconds = Annotated[float, Field(gt=0, le=3600)]
_MEMORY = "a module that holds more memory of its own is ended"
Megabytes = Annotated[int, Field(ge=64, le=10_000_000)]


class RestartOptions(Section):
    """`[ops.restart]`: modules to be restarted after a failure."""

    robot: Restart = Field(default="never", description="whether it is restarted; it holds then")
    perception: Restart = Field(default="on_failure", description="whether it is restarted")
    inference: Restart = Field(
        default="never", description="whether it is restarted; without an instruction"
    )
    control: Restart = Field(default="never", description="whether it is restarted; it holds then")

    def policy(self, kind: ModuleKind) -> Restart:
        """The policy of one module; one of a kind that a feature adds is not restarted."""
        policies: dict[ModuleKind, Restart] = {
            "robot": self.robot,
            "perception": self.perception,
            "inference": self.inference,
            "control": self.control,
        }
        return policies.get(kind, "never")


class MemoryOptions(Section):
    """`[ops.memory_limit_mb]`: maximum memory of each module's process [MB]; no limit if unset."""

    robot: Megabytes | None = Field(default=None, description=_MEMORY)
    perception: Megabytes | None = Field(default=None, description=_MEMORY)
    inference: Megabytes | None = Field(default=None, description=_MEMORY)
    control: Megabytes | None = Field(default=None, description=_MEMORY)

    def limit_mb(self, kind: ModuleKind) -> int | None:
        """The limit of one module; none for a kind that a feature adds."""
        limits: dict[ModuleKind, int | None] = {
            "robot": self.robot,
            "perception": self.perception,
            "inference": self.inference,
            "control": self.control,
        }
        return limits.get(kind)


class OpsOptions(Section):
    """`[ops]`: restarts and memory limits of module processes."""

    restart: RestartOptions = Field(
        default=RestartOptions(), description="by module: never, on_failure"
    )
    memory_limit_mb: MemoryOptions = Field(
        default=MemoryOptions(), description="by module; none: not limited"
    )
    unresponsive_s: Seconds = Field(
        default=2.0, description="frozen for this long, a module may be restarted"
    )
    restart_backoff_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=0.5, description="wait before a restart; doubled by each one before it"
    )
    restart_limit: Annotated[int, Field(ge=0, le=100)] = Field(
        default=3, description="most restarts in one window for faults of the module itself"
    )
    restart_window_s: Seconds = Field(default=120.0, description="restarts longer ago do not count")
    overload_restart_limit: Annotated[int, Field(ge=0, le=100)] = Field(
        default=10,
        description="most restarts in an hour while the machine is overloaded; these wait up to "
        "60 s",
    )
