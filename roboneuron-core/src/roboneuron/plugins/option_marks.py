"""Marks of options: what only the configuration may set, and what agents may set nevertheless."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

SCHEMA_KEY = "x-configuration-only"
"""Key in the JSON schema of a marked option, with the value true."""


@dataclass(frozen=True, slots=True)
class ConfigurationOnly:
    """Marks an option that only the configuration may set: a host, a file, a command, a variable.

    `url: Annotated[str, ConfigurationOnly()]`. An option without a mark counts as restricted if its
    type or name indicates such a value; `AgentMaySet()` lifts that. The feature through which
    agents set options applies this; `agent_options` of `[selection]` lists exceptions for admins.
    """

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Set the mark in the option's JSON schema."""
        return {**handler(schema), SCHEMA_KEY: True}


@dataclass(frozen=True, slots=True)
class AgentMaySet:
    """Marks an option whose type or name looks restricted, but that refers to nothing outside of
    the plugin.
    """
