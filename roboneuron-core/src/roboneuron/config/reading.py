"""Text to `Config`; an unknown key is an error with a suggestion."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from roboneuron.config.whole import Config
from roboneuron.errors import ConfigurationError

EMBEDDED_DEFAULT = "the embedded default"
"""How messages call the configuration that is used when the user gives none."""


def _valid_keys(location: tuple[int | str, ...]) -> list[str]:
    """Keys allowed in the section that `location` (of an error) points into."""
    model: Any = Config
    for part in location[:-1]:
        if isinstance(part, int):  # an entry of an array of tables
            continue
        field = model.model_fields.get(part) if hasattr(model, "model_fields") else None
        if field is None:
            return []
        candidates = [field.annotation, *getattr(field.annotation, "__args__", ())]
        candidates += [a for c in candidates for a in getattr(c, "__args__", ())]
        model = next((c for c in candidates if hasattr(c, "model_fields")), None)
        if model is None:
            return []
    return sorted(model.model_fields)


def _explain(error: ValidationError, source: str) -> ConfigurationError:
    lines = []
    for item in error.errors(include_url=False):
        location = item["loc"]
        key = ".".join(str(part) for part in location)
        if item["type"] == "extra_forbidden":
            valid = _valid_keys(location)
            near = get_close_matches(str(location[-1]), valid, n=1, cutoff=0.5)
            nearest = f" Did you mean {near[0]!r}?" if near else f" Valid keys: {', '.join(valid)}."
            lines.append(f"{source}: unknown key {key!r}.{nearest}")
        elif item["type"] == "missing":
            lines.append(f"{source}: {key!r} is missing.")
        else:
            lines.append(f"{source}: {key} = {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}.")
    return ConfigurationError("\n".join(lines))


def parse_config(text: str, *, source: str = "roboneuron.toml") -> Config:
    """Parse the text of a roboneuron.toml.

    Args:
        text: TOML.
        source: file name for messages.

    Raises:
        ConfigurationError: not TOML, or a key or value is not valid; names file, key and the nearest valid key.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source} is not valid TOML: {error}.") from error
    try:
        return Config.model_validate(raw)
    except ValidationError as error:
        raise _explain(error, source) from error


def default_text() -> str:
    """Text of the embedded default configuration."""
    return files("roboneuron").joinpath("data/default.toml").read_text(encoding="utf-8")


def load_config(path: Path | None = None) -> Config:
    """Read `path`, or the embedded default when None.

    Raises:
        ConfigurationError: the file cannot be read or is not valid.
    """
    if path is None:
        return parse_config(default_text(), source=EMBEDDED_DEFAULT)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}.") from error
    return parse_config(text, source=str(path))
