"""The configuration of an episode's server."""

from __future__ import annotations

import json
from pathlib import Path

from rn_eval.agents.client import TOKEN
from rn_eval.agents.record import TimeMode
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
{inference}[{table}control]
controller = "urdf"
{control}[{table}plugins.fr3]
seed = {seed}
colours = [{colours}]
"""
_ALONE = '[robot]\nname = "fr3"\ndriver = "simulated"\n'
_STEPPED_ROBOT = "command_timeout_s = 90.0\nserver_timeout_s = 30.0\n"
_STEPPED_INFERENCE = "max_image_age_s = 60.0\nmax_tail_age_s = 600.0\n"
_STEPPED_CONTROL = "action_timeout_s = 60.0\nstate_timeout_s = 30.0\nserver_timeout_s = 30.0\n"
"""On a busy machine commands come late, and the simulation waits for them: nothing moves meanwhile.
Control holds 45 s after the last action, when the simulation rests.
"""
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
_LABELS = '[sight]\nlocator = "relabelled"\n[plugins.relabelled.labels]\n'
_START_TIMEOUT = "start_timeout_s = 200.0\n"
_OTHERS_LEASE_S = 12.0
"""Lease time of another client, which operates the robot and then stays silent."""


def configuration_of(scene: AgentScene, state: Path, time: TimeMode = "real") -> str:
    """A roboneuron.toml with what the scene says.

    Args:
        scene: of one robot where time is stepped.
        state: directory in which the server keeps its state.
        time: of the simulation.
    """
    parts = [
        _SHARED.format(
            state=state,
            start_timeout=_START_TIMEOUT if scene.companions or time == "stepped" else "",
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
        is_stepped = time == "stepped"
        parts.append(_ALONE + (_STEPPED_ROBOT if is_stepped else ""))
        parts.append(_arm("", scene.backend, scene.seed, scene.colours, is_stepped))
    parts += [
        f'[[limits.zones]]\nname = "zone{number}"\nlower_m = {list(lower)}\n'
        f"upper_m = {list(upper)}\n"
        for number, (lower, upper) in enumerate(scene.zones_m, 1)
    ]
    if scene.labels:
        parts.append(_LABELS)
        parts += [f"{colour} = {json.dumps(label)}\n" for colour, label in scene.labels.items()]
    return "".join(parts)


def _arm(
    table: str, backend: str, seed: int, colours: tuple[str, ...], is_stepped: bool = False
) -> str:
    listed = ", ".join(f'"{colour}"' for colour in colours)
    control = _STEPPED_CONTROL if is_stepped else ""
    text = _ARM.format(
        table=table,
        backend=backend,
        inference=_STEPPED_INFERENCE if is_stepped else "",
        control=control,
        seed=seed,
        colours=listed,
    )
    return text + ("stepped = true\n" if is_stepped else "")
