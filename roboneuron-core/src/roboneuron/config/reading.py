"""Text to `Config`; an unknown key is an error with a suggestion."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path

from pydantic import ValidationError

from roboneuron.config.explaining import explain
from roboneuron.config.features import KEYS, check_sections
from roboneuron.config.whole import Config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry

EMBEDDED_DEFAULT = "the embedded default"
"""How messages call the configuration that is used when the user gives none."""


def parse_config(text: str, *, source: str = "roboneuron.toml", registry: Registry | None = None) -> Config:
    """Parse the text of a roboneuron.toml.

    Args:
        text: TOML.
        source: file name for messages.
        registry: what is installed; discovered when there are sections that core does not know.

    Raises:
        ConfigurationError: not TOML, or a key or value is not valid; names file, key and the nearest valid key.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{source} is not valid TOML: {error}.") from error
    own = {key: value for key, value in raw.items() if key in KEYS}
    others = {key: value for key, value in raw.items() if key not in KEYS}
    try:
        config = Config.model_validate(own)
    except ValidationError as error:
        raise explain(error, Config, source) from error
    if others:
        config = config.model_copy(update={"sections": others})
        check_sections(config, registry or discover(config.disabled_plugins), source)
    return config


def default_text() -> str:
    """Text of the embedded default configuration."""
    return files("roboneuron").joinpath("data/default.toml").read_text(encoding="utf-8")


def load_config(path: Path | None = None, registry: Registry | None = None) -> Config:
    """Read `path`, or the embedded default when None; `registry` as in `parse_config`.

    Raises:
        ConfigurationError: the file cannot be read or is not valid.
    """
    if path is None:
        return parse_config(default_text(), source=EMBEDDED_DEFAULT, registry=registry)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}.") from error
    return parse_config(text, source=str(path), registry=registry)
