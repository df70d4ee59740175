"""A served fr3-pair with the plugin of pair_policies.py, from an agent's view; for tests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio

from rn_standard.demo.agent import DemoAgent
from rn_testing.fakes.site import plugin_site

CONFIG = """
[robot]
name = "fr3-pair"
[perception]
source = "numbered"
cameras = ["front"]
[inference]
backend = "waving"
[control]
controller = "urdf"
"""
STILL_RAD = 0.002
PATIENCE_S = 30.0


@contextmanager
def configured(folder: Path) -> Iterator[tuple[Path, Path]]:
    """A configuration below `folder` that uses the plugin, and the plugin's installation folder."""
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG)
    with plugin_site(folder / "site") as site:
        source = Path(__file__).with_name("pair_policies.py").read_text()
        site.install("pair-policies", source, header="")
        yield config, site.path


async def positions(agent: DemoAgent) -> dict[str, float]:
    messages: Any = (await agent.call("read_joint_states"))["messages"]
    return dict(zip(messages[-1]["name"], messages[-1]["position"], strict=True))


async def moved_rad(agent: DemoAgent, pause_s: float) -> dict[str, float]:
    """Displacement of each arm's fastest joint in that time [rad]."""
    before = await positions(agent)
    await anyio.sleep(pause_s)
    after = await positions(agent)
    return {
        arm: max(abs(after[n] - before[n]) for n in after if n.startswith(f"{arm}_fr3_joint"))
        for arm in ("left", "right")
    }
