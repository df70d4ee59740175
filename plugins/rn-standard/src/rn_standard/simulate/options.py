"""The section `[simulate]` of roboneuron.toml."""

from __future__ import annotations

from pydantic import Field

from roboneuron import Section


class SimulateOptions(Section):
    """`[simulate]`: calls with simulate=true."""

    limit_s: float = Field(
        default=20.0, gt=0, le=60, description="longest time that one may take [s]"
    )
    objects: bool = Field(
        default=True, description="a simulated cell tells its twin where the objects are"
    )
