"""The section `[link]` of roboneuron.toml."""

from __future__ import annotations

from pydantic import Field

from roboneuron import Section


class LinkOptions(Section):
    """`[link]`: the encrypted link between machines."""

    required: bool = Field(
        default=False, description="start the server only if another machine is paired"
    )
    warn_days: int = Field(
        default=30,
        ge=0,
        le=3650,
        description="warn this long before a certificate expires [days]",
    )
