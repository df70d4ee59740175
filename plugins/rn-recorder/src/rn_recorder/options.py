"""The section `[recorder]` of roboneuron.toml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron import Section


class RecorderOptions(Section):
    """`[recorder]`: content, place and retention of recordings."""

    enabled: bool = Field(
        default=True, description="false: no recorder's process, no ring, no incidents"
    )
    record: bool = Field(
        default=False, description="a recording begins with the server; otherwise only the ring"
    )
    directory: str | None = Field(
        default=None, description="of the runs; by default `runs` in the state directory"
    )
    topics: tuple[str, ...] = Field(
        default=("*", "/diagnostics", "/tf", "/tf_static", "/robot_description"),
        strict=False,
        description="patterns; without a slash in front under the robot's namespace",
    )
    exclude: tuple[str, ...] = Field(
        default=("*/transition_event",), strict=False, description="patterns of what is left out"
    )
    images: Literal["jpeg", "lossless"] = Field(
        default="jpeg",
        description="jpeg: small; lossless: the message itself, which an exact replay needs",
    )
    jpeg_quality: Annotated[int, Field(ge=30, le=100)] = Field(
        default=85, description="of JPEG images"
    )
    ring_s: Annotated[float, Field(ge=0, le=600)] = Field(
        default=30.0,
        description="time before an incident that is kept; 0: no ring and no incidents",
    )
    incident_after_s: Annotated[float, Field(ge=0, le=120)] = Field(
        default=5.0, description="time after an incident that is kept"
    )
    incident_most_s: Annotated[float, Field(ge=10, le=3600)] = Field(
        default=300.0,
        description="faults that follow each other are one incident of at most so long",
    )
    part_mb: Annotated[int, Field(ge=1, le=100_000)] = Field(
        default=500, description="largest file of a recording"
    )
    part_s: Annotated[float, Field(ge=1, le=86_400)] = Field(
        default=300.0, description="longest file of a recording"
    )
    quota_mb: Annotated[int, Field(ge=10, le=100_000_000)] = Field(
        default=10_000,
        description="all files together; the oldest are deleted, recordings before incidents",
    )
    keep_days: Annotated[float, Field(ge=0, le=36_500)] = Field(
        default=0.0,
        description="recordings and incidents that are older are deleted; 0: by size alone",
    )
    min_free_mb: Annotated[int, Field(ge=0, le=10_000_000)] = Field(
        default=500, description="with less free space on the disk recording pauses"
    )
