"""Record demonstrations with `lerobot-record` through ROS: `make record-lerobot`.

A server simulates the FR3; `lerobot-record` drives it with the robot and the teleoperator
`roboneuron` of lerobot_robot_roboneuron, in its own interpreter, following a scripted leader
(`cube_leader.py`). It records in blocks of some episodes: each has its own server, cube size and
data set, and an unfinished one is recorded again. Episodes in which the cube was not picked up are
deleted, and lerobot merges the rest.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import anyio
from cube_leader import LIFTED_M, CubeLeader

from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent
from roboneuron import NotReadyError, RoboNeuronError
from roboneuron.command import environment

CONFIG = Path(__file__).with_name("lerobot_act.toml")
FPS, EPISODE_S, RESET_S = 10, 7.0, 10.0
SIDE_PX = 96
"""Size of the images, as in `CONFIG`."""
TASK = "pick up the red cube"
LATE_S = 2.0
"""Maximum age of states, images and the leader's joints, for a busy machine."""
MOST_FAILURES = 3
"""Number of blocks without a good episode after which it gives up."""
FIRST_SEED = 20_000
"""First seed of the scenes; lower ones are for evaluation."""
_BEGINS, _RESETS, _ENDS = "Recording episode", "Reset the environment", "Stop recording"


class Recording:
    """One run of `lerobot-record` with a leader."""

    def __init__(self, lerobot: Path, folder: Path, count: int, log: Path) -> None:
        """Args:
        lerobot: folder with lerobot's commands.
        folder: folder of the data set; must not exist.
        count: number of episodes.
        log: file for lerobot's output.
        """
        self._command = [
            str(lerobot / "lerobot-record"),
            "--robot.type=roboneuron",
            "--robot.robot=fr3",
            f"--robot.width={SIDE_PX}",
            f"--robot.height={SIDE_PX}",
            f"--robot.state_timeout_s={LATE_S}",
            f"--robot.image_timeout_s={LATE_S}",
            "--teleop.type=roboneuron",
            "--teleop.robot=fr3",
            f"--teleop.timeout_s={LATE_S}",
            "--dataset.repo_id=local/cubes",
            f"--dataset.root={folder}",
            f"--dataset.single_task={TASK}",
            f"--dataset.fps={FPS}",
            f"--dataset.num_episodes={count}",
            f"--dataset.episode_time_s={EPISODE_S}",
            f"--dataset.reset_time_s={RESET_S}",
            "--dataset.video=false",
            "--dataset.push_to_hub=false",
            "--dataset.no_stamp=true",
            "--play_sounds=false",
        ]
        self._log = log
        self._lying_m: float | None = None
        self.lifted: list[bool] = []

    def run(self, leader: CubeLeader) -> None:
        """Run until its end; `lifted` then tells for each episode whether the cube was lifted.

        Raises:
            NotReadyError: it failed; contains its last output.
        """
        variables = {**os.environ, "HF_HUB_OFFLINE": "1", "PYTHONWARNINGS": "ignore"}
        with (
            self._log.open("w", encoding="utf-8") as log,
            subprocess.Popen(
                self._command,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                env=variables,
            ) as process,
        ):
            assert process.stdout is not None
            try:
                for line in process.stdout:
                    log.write(line)
                    self._follow(line, leader)
            except BaseException:
                process.terminate()
                raise
        if process.returncode:
            last = self._log.read_text(encoding="utf-8").strip().rpartition("\n")[2]
            raise NotReadyError(f"lerobot-record failed: {last}", hint=f"See {self._log}.")

    def _follow(self, line: str, leader: CubeLeader) -> None:
        """Control the leader by a line of lerobot's log."""
        if _BEGINS in line:
            self._lying_m = leader.cube().position_m[2]
            leader.demonstrate()
        elif (_RESETS in line or _ENDS in line) and self._lying_m is not None:
            lifted_m = leader.cube().position_m[2] - self._lying_m
            self._lying_m = None
            self.lifted.append(bool(lifted_m > LIFTED_M))
            print(f"  episode {len(self.lifted)}: lifted by {lifted_m * 100:.1f} cm", flush=True)
            if _RESETS in line:
                leader.put_elsewhere()


async def record_block(folder: Path, count: int, seed: int, lerobot: Path) -> Sequence[bool]:
    """Record one block; return whether each of its cubes was picked up, empty if lerobot or a
    module failed, which is printed.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    config = folder.with_suffix(".toml")
    text = CONFIG.read_text(encoding="utf-8")
    section = "[plugins.fr3]\n"
    config.write_text(text.replace(section, f"{section}seed = {seed}\n"), encoding="utf-8")
    recording = Recording(lerobot, folder, count, folder.with_suffix(".log"))
    leader = CubeLeader(seed)
    async with spawned_server(
        ["--config", str(config)], folder.with_suffix(".server.log")
    ) as client:
        agent = DemoAgent(client)
        leader.open()
        try:
            for tool in ("start_robot", "start_perception", "start_control"):
                await agent.call(tool)
            await anyio.to_thread.run_sync(recording.run, leader)
        except NotReadyError as error:
            print(error, flush=True)
            return []
        finally:
            leader.close()
            with suppress(RoboNeuronError):  # the server ends next, with everything that still runs
                await agent.call("stop_all")
    return recording.lifted


def edit(lerobot: Path, *options: str) -> None:
    """Run `lerobot-edit-dataset`. Raises CalledProcessError."""
    command = [str(lerobot / "lerobot-edit-dataset"), *options]
    subprocess.run(command, check=True, env={**os.environ, "HF_HUB_OFFLINE": "1"})


def merge(blocks: Sequence[Path], folder: Path, lerobot: Path) -> None:
    """Merge all blocks into one data set with lerobot. Raises CalledProcessError."""
    merged = folder.with_suffix(".merged")
    shutil.rmtree(merged, ignore_errors=True)
    roots = ", ".join(f"'{block}'" for block in blocks)
    names = ", ".join("'local/cubes'" for _ in blocks)
    edit(
        lerobot,
        "--operation.type=merge",
        f"--operation.repo_ids=[{names}]",
        f"--operation.roots=[{roots}]",
        "--new_repo_id=local/cubes",
        f"--new_root={merged}",
    )
    shutil.rmtree(folder, ignore_errors=True)
    merged.rename(folder)


def episodes_in(folder: Path) -> int:
    """Number of episodes in a data set; 0 if it does not exist."""
    facts = folder / "meta" / "info.json"
    if not facts.exists():
        return 0
    return int(json.loads(facts.read_text(encoding="utf-8"))["total_episodes"])


def finish_block(block: Path, lifted: Sequence[bool], lerobot: Path) -> None:
    """Delete the episodes without a lifted cube, and store the number of the remaining ones.

    Raises:
        CalledProcessError: lerobot failed.
    """
    failed = [number for number, was_lifted in enumerate(lifted) if not was_lifted]
    if failed:
        kept = block.with_suffix(".kept")
        shutil.rmtree(kept, ignore_errors=True)
        edit(
            lerobot,
            "--repo_id=local/cubes",
            f"--root={block}",
            f"--new_root={kept}",
            "--operation.type=delete_episodes",
            f"--operation.episode_indices={failed}",
        )
        shutil.rmtree(block)
        kept.rename(block)
    note_of(block).write_text(json.dumps(len(lifted) - len(failed)), encoding="utf-8")


def note_of(block: Path) -> Path:
    """The file with the number of good episodes of a finished block."""
    return block.with_suffix(".json")


def main() -> int:
    """Record the missing blocks, and merge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=50, help="episodes (default: 50)")
    parser.add_argument("--block", type=int, default=10, help="most of a block (default: 10)")
    parser.add_argument("--lerobot", type=Path, default=Path(".venv-lerobot/bin"))
    parser.add_argument("--out", type=Path, default=Path("out/lerobot"))
    chosen = parser.parse_args()
    environment.prepare_environment()
    os.environ["ROBONEURON_RECORDER"] = "off"  # lerobot records
    good, number, failures, blocks = 0, 0, 0, list[Path]()
    while good < chosen.n and failures < MOST_FAILURES:
        block = (chosen.out / "blocks" / f"{number:03d}").absolute()
        if not note_of(block).exists():
            shutil.rmtree(block, ignore_errors=True)
            count = min(chosen.block, chosen.n - good)
            lifted = anyio.run(record_block, block, count, FIRST_SEED + number, chosen.lerobot)
            if not any(lifted):
                failures += 1
                continue
            finish_block(block, lifted, chosen.lerobot)
            print(f"{block}: {sum(lifted)} of {len(lifted)} cubes were picked up", flush=True)
        good += int(note_of(block).read_text(encoding="utf-8"))
        number += 1
        blocks.append(block)
    if good < chosen.n:
        print(f"{failures} blocks have failed. Is the machine too busy? Begin again to go on.")
        return 1
    data = (chosen.out / "data").absolute()
    if episodes_in(data) != good:
        merge(blocks, data, chosen.lerobot)
    print(f"{chosen.out / 'data'}: {good} episodes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
