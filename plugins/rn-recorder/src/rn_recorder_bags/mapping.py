"""The file that says what the topics of a lab's bags are: `roboneuron runs import --map FILE`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from roboneuron import ConfigurationError, ForeignDataError, Section, foreign

NEXT_STATE = "next_state"
Seconds = Annotated[float, Field(gt=0, le=86_400)]
_Names = Annotated[dict[str, str], Field(min_length=1, max_length=256)]


class TopicSource(Section):
    """A topic."""

    topic: str = Field(min_length=1, description="name of the topic")
    max_age_s: Seconds | None = Field(
        default=None,
        description="longest hold of its newest message; by default the file's",
    )


class NumberSource(TopicSource):
    """`[[state]]` or `[[action]]`: a topic with numbers."""

    values: _Names = Field(
        description="name in the data set by name of the joint in a JointState or JointTrajectory, "
        "in another message by field, such as `data[0]` or `pose.position.x`"
    )


_Sources = Annotated[tuple[NumberSource, ...], Field(min_length=1, strict=False)]


class EpisodeCuts(Section):
    """`[episodes]`: where episodes begin and end; without it a bag is one."""

    topic: str | None = Field(default=None, description="messages that begin and end episodes")
    field: str = Field(default="data", description="of these messages")
    begin: str | bool | int | float | None = Field(
        default=None,
        description="value that begins one; by default each but false, 0 and the empty text, "
        "and a text is the instruction",
    )
    end: str | bool | int | float | None = Field(
        default=None, description="value that ends one; by default false, 0 and the empty text"
    )
    silence_s: Seconds | None = Field(
        default=None, description="a pause of the action's topics that ends one"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.topic is None) == (self.silence_s is None):
            raise ValueError("give either topic or silence_s")
        return self


class BagMapping(Section):
    """What the topics of a lab's bags are, and how they are resampled."""

    fps: Annotated[int, Field(ge=1, le=1000)] = Field(description="rows per second")
    state: _Sources = Field(description="measured values, in this order")
    action: Literal["next_state"] | _Sources = Field(
        description="commands, in this order, or `next_state`"
    )
    cameras: dict[Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")], TopicSource] = Field(
        default={}, description="topics of images by camera"
    )
    episodes: EpisodeCuts | None = Field(default=None, description="by default one per bag")
    time: Literal["log", "header"] = Field(
        default="log",
        description="log: when a message was recorded; header: its stamp, if its type has one",
    )
    max_age_s: Seconds = Field(default=0.2, description="longest hold of a newest message")
    jump_s: Seconds = Field(default=0.1, description="least step of a clock that ends an episode")
    instruction: str = Field(
        default="", description="of episodes without one; the bag's name when not given"
    )
    robot: str | None = Field(default=None, description="name of the robot")

    @model_validator(mode="after")
    def _check(self) -> Self:
        for part in (self.state, self.actions):
            counts = Counter(name for source in part for name in source.values.values())
            twice = [name for name, count in counts.items() if count > 1]
            if twice:
                raise ValueError(f"{', '.join(twice)} of the data set is named twice")
        topics = [camera.topic for camera in self.cameras.values()]
        if len(set(topics)) < len(topics):
            raise ValueError("two cameras have the same topic")
        return self

    @property
    def actions(self) -> tuple[NumberSource, ...]:
        """Topics of the commands; those of the state for `next_state`."""
        return self.state if isinstance(self.action, str) else self.action


def read_mapping(path: Path) -> BagMapping:
    """Read a file of TOML.

    Raises:
        ConfigurationError: it cannot be read, or a key is unknown, missing or wrong.
    """
    try:
        tables = foreign.decode_toml(foreign.read_text(path), path.name)
        return foreign.to_model(BagMapping, tables, path.name)
    except FileNotFoundError as error:
        raise ConfigurationError(
            f"There is no file {path}.", hint="The page `Record, keep, replay` shows one."
        ) from error
    except ForeignDataError as error:
        raise ConfigurationError(f"{error.message}.", hint=error.hint) from error
