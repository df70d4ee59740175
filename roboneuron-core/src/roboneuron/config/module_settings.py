"""What a module process is told by the server."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.config.models import Config, LimitsConfig, ModuleKind


class ModuleSettings(BaseModel):
    """One line of JSON on the stdin of a module process.

    Attributes:
        kind: kind of the module.
        node_name: name of its ROS node under the robot's namespace; the kind unless several run in
            parallel.
        config: the effective configuration, overrides of the start call included.
        state_directory: where the emergency-stop latch is kept.
        needs_start: reason for which a module that moves the robot refuses commands until motion is
            requested; empty for none.
        on_join: "module:attribute" of functions of features, called with the module's node
            (`ModuleHost`).
        tightened: limits that replace the configured ones, none of them wider.
        is_successor: a module of its kind works already; a filter says when this one replaces it.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: ModuleKind
    node_name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    config: Config
    state_directory: str = ""
    tightened: LimitsConfig | None = None
    is_successor: bool = False
    needs_start: str = ""
    on_join: tuple[str, ...] = ()

    @property
    def status_name(self) -> str:
        """Name of the module's DiagnosticStatus: "<namespace>/<node name>"."""
        return f"{self.config.namespace}/{self.node_name}"
