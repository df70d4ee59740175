"""The flag `--option` of commands that create plugins: options of any of them, in one notation."""

from __future__ import annotations

import datetime
import json
import tomllib
from argparse import ArgumentParser
from collections.abc import Sequence

from roboneuron import ConfigurationError

FORM = "[PLUGIN.]NAME=VALUE"


def add_option(parser: ArgumentParser, own: str) -> None:
    """Add --option, for `read_options`; options of `own`, such as "the backend", need no plugin's
    name.
    """
    told = (
        "an option of any plugin, VALUE as in TOML or JSON, else text; without PLUGIN one of "
        f"{own}; repeatable"
    )
    parser.add_argument("--option", action="append", default=[], metavar=FORM, help=told)


def read_options(texts: Sequence[str], own: str) -> dict[str, dict[str, object]]:
    """Parse options by plugin from texts such as `oft.unnorm_key=tiny`; without a plugin's name
    they belong to `own`.

    Raises:
        ConfigurationError: a text is not of that form.
    """
    found: dict[str, dict[str, object]] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        plugin, dot, option = name.rpartition(".")
        if not (equals and option.isidentifier()) or (dot and not plugin):
            raise ConfigurationError(
                f"--option is {text!r}, expected {FORM}.",
                hint="Write gain=0.5, or servo.gain=0.5 for an option of the plugin servo.",
            )
        found.setdefault(plugin or own, {})[option] = read_value(value)
    return found


def read_value(text: str) -> object:
    """Parse a value as TOML or JSON if possible, else return the text; dates stay text."""
    try:
        value: object = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        try:
            return json.loads(text)
        except ValueError:
            return text
    return text if isinstance(value, datetime.date | datetime.time) else value
