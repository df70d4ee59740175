"""The learned policy behind `roboneuron policy openpi`: episodes in simulation equal those of the
same policy in the worker's own process, action by action and bit for bit.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROBOT = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "openpi"
[control]
controller = "urdf"
[plugins.openpi]
url = "{url}"
coding = "raw"
space = {{ kind = "ee_delta" }}
"""
COMMAND = (sys.executable, "-m", "roboneuron.cli.main")


def run(*arguments: object) -> None:
    done = subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def episodes(folder: Path) -> list[dict[str, object]]:
    """Status and digest (of every action and the simulator's last state) of each episode."""
    lines = (folder / "episodes.jsonl").read_text().splitlines()
    outcomes = [json.loads(line)["outcome"] for line in lines]
    return [{key: outcome[key] for key in ("status", "digest", "rows")} for outcome in outcomes]


@pytest.mark.slow
def test_episodes_over_the_websocket_are_those_without_it(tmp_path: Path) -> None:
    policy = tmp_path / "policy"
    run("policy", "cubes", "unpack", policy)
    local = policy / "roboneuron.toml"
    served = tmp_path / "gpu.toml"
    text = local.read_text().replace("[inference]\n", f'[inference]\ncheckpoint = "{policy}"\n', 1)
    served.write_text(f"{text}\n[plugins.openpi.server]\nport = 0\n")
    common = ("--episodes", 4, "--seed", 10000, "--workers", 1)
    command = [*COMMAND, "policy", "openpi", "--config", str(served)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            url = server.stdout.readline().split()[2]
            robot = tmp_path / "robot.toml"
            robot.write_text(ROBOT.format(url=url))
            out = tmp_path / "remote"
            run("eval", "run", "--backend", "openpi", "--config", robot, *common, "--out", out)
        finally:
            server.terminate()
    own = ("--backend", "oft-primary", "--checkpoint", policy, "--config", local)
    run("eval", "run", *own, *common, "--out", tmp_path / "local")
    remote = episodes(tmp_path / "remote")
    assert [episode["status"] for episode in remote] == ["success"] * 4
    assert remote == episodes(tmp_path / "local")
