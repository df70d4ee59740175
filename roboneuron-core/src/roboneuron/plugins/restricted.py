"""Marks of plugin options that tell whether an agent may set them.

Hosts, files, commands and environment variables are for the configuration:
    `url: Annotated[str, ConfigurationOnly()]`.
An option without a mark counts as restricted when its type or name says that it names such a thing;
`AgentMaySet()` lifts that. The feature that lets agents set options goes by this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

SCHEMA_KEY = "x-configuration-only"
"""True in the JSON schema of an option that is marked."""


@dataclass(frozen=True, slots=True)
class ConfigurationOnly:
    """Marks an option that only the configuration sets; `agent_options` of `[server]` lists
    exceptions for admins.
    """

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Say so in the option's JSON schema."""
        return {**handler(schema), SCHEMA_KEY: True}


@dataclass(frozen=True, slots=True)
class AgentMaySet:
    """Marks an option whose type or name looks restricted, but that names nothing outside of the
    plugin.
    """
