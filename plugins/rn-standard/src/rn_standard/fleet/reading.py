"""Parsing of `[robots.<name>]` in roboneuron.toml: a complete configuration for each robot."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping

from roboneuron import ConfigurationError, FeatureSpec, RobotSpec
from roboneuron.feature import Config, Registry, reading


def read_robots(raw: Mapping[str, object], source: str, registry: Registry) -> Config:
    """Combine each `[robots.<name>]` with the shared tables to a complete configuration, in
    `robots` of the result.

    Args:
        raw: the tables of the file.
        source: its name for messages.
        registry: the installed plugins.

    Raises:
        ConfigurationError: as `parse_config`; names the robot.
    """
    shared = {key: value for key, value in raw.items() if key != "robots"}
    tables = raw["robots"]
    if "robot" in shared:
        raise ConfigurationError(f"{source}: either [robot] or [robots.<name>], not both.")
    if not isinstance(tables, dict) or not tables:
        raise ConfigurationError(f"{source}: robots = {tables!r}: expected tables [robots.<name>].")
    served = {
        key for spec in registry.specs(FeatureSpec).values() if spec.transports for key in spec.keys
    }
    robots: dict[str, Config] = {}
    for name, table in tables.items():
        place = f"{source}, [robots.{name}]"
        if not re.fullmatch(r"[a-z][a-z0-9_-]{0,31}", name):
            raise ConfigurationError(
                f"{place}: a robot's name is made of a-z, 0-9, - and _, at most 32."
            )
        if not isinstance(table, dict):
            raise ConfigurationError(
                f"{source}: robots.{name} = {table!r}: expected a table.",
                hint="For one robot write [robot]; for several, [robots.NAME] for each.",
            )
        if "robot" not in table:
            kinds = ", ".join(sorted(registry.specs(RobotSpec))) or "none"
            raise ConfigurationError(
                f"{place}: 'robot' is missing.",
                hint=f'Write which it is, such as `robot = "husky"`; installed: {kinds}.',
            )
        for key in sorted(
            {"server", "ros", "disabled_plugins", "features", "robots", *served} & table.keys()
        ):
            raise ConfigurationError(
                f"{place}: {key!r} is shared by all robots: write it at the top level."
            )
        robot = (
            dict(table["robot"]) if isinstance(table["robot"], dict) else {"name": table["robot"]}
        )
        robot.setdefault("namespace", name.replace("-", "_"))
        pairs = {key: (shared.get(key), table.get(key)) for key in ("plugins", "models")}
        both = {
            key: {**a, **b}
            for key, (a, b) in pairs.items()
            if isinstance(a, dict) and isinstance(b, dict)
        }
        robots[name] = robot_config = reading.parse_tables(
            {**shared, **table, **both, "robot": robot}, place, registry
        )
        if "supervisor" in table and robot_config.supervisor.state_directory is not None:
            raise ConfigurationError(
                f"{place}: 'state_directory' is shared: each robot has a folder of its own in it."
            )
    namespaces = Counter(one.namespace for one in robots.values())
    for namespace in (namespace for namespace, count in namespaces.items() if count > 1):
        raise ConfigurationError(f"{source}: two robots have the namespace {namespace!r}.")
    first = next(iter(robots.values())).robot.model_dump(exclude_none=True)
    return reading.parse_tables({**shared, "robot": first}, source, registry).model_copy(
        update={"robots": robots}
    )
