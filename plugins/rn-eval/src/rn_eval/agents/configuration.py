"""The configuration of an episode's server."""

from __future__ import annotations

from pathlib import Path

from rn_eval.agents.client import TOKEN
from rn_eval.agents.task import AgentScene, Companion

_SHARED = """\
[supervisor]
state_directory = "{state}"
{start_timeout}[http]
lease_s = {lease_s}
[[http.tokens]]
name = "agent"
role = "admin"
variable = "{token}"
[[http.tokens]]
name = "colleague"
role = "operator"
variable = "{token}_2"
"""
_ARM = """\
[{table}perception]
source = "fr3-sim-camera"
[{table}inference]
backend = "{backend}"
[{table}control]
controller = "urdf"
[{table}plugins.fr3]
seed = {seed}
colours = [{colours}]
"""
_ALONE = '[robot]\nname = "fr3"\ndriver = "simulated"\n'
_ONE_OF_SEVERAL = '[robots.{name}]\nrobot = "{robot}"\n'
_SEVERAL = """\
[plugins.fr3-sim-camera]
rate_hz = 5.0
width = 160
height = 160
[plugins.servo]
rows = 2
"""
"""Same rates as in the demo with several robots, which two processor cores can sustain."""
_START_TIMEOUT = "start_timeout_s = 200.0\n"
_OTHERS_LEASE_S = 12.0
"""Lease time of another client, which operates the robot and then stays silent."""


def configuration_of(scene: AgentScene, state: Path) -> str:
    """Return the roboneuron.toml of a scene; the server keeps its state in `state`."""
    parts = [
        _SHARED.format(
            state=state,
            start_timeout=_START_TIMEOUT if scene.companions else "",
            lease_s=_OTHERS_LEASE_S if scene.other_client else '"auto"',
            token=TOKEN,
        )
    ]
    if scene.companions:
        parts.append(_SEVERAL)
        own = Companion(name=scene.robot, seed=scene.seed, colours=scene.colours)
        for one in (own, *scene.companions):
            parts.append(_ONE_OF_SEVERAL.format(name=one.name, robot=one.robot))
            if one.colours:
                table = f"robots.{one.name}."
                parts.append(_arm(table, scene.backend, one.seed, one.colours))
    else:
        parts += [_ALONE, _arm("", scene.backend, scene.seed, scene.colours)]
    parts += [
        f'[[limits.zones]]\nname = "zone{number}"\nlower_m = {list(lower)}\n'
        f"upper_m = {list(upper)}\n"
        for number, (lower, upper) in enumerate(scene.zones_m, 1)
    ]
    return "".join(parts)


def _arm(table: str, backend: str, seed: int, colours: tuple[str, ...]) -> str:
    listed = ", ".join(f'"{colour}"' for colour in colours)
    return _ARM.format(table=table, backend=backend, seed=seed, colours=listed)
