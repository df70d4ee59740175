"""All demonstrations of a recipe, by several processes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from rn_policy_cubes.demonstrations import shard_files, write_shard
from roboneuron import PluginError

Say = Callable[[str], None]


def record(directory: Path, count: int, *, workers: int, say: Say) -> None:
    """Make the shards below `count` that are not there.

    Args:
        directory: of the shards.
        count: how many there are to be.
        workers: processes.
        say: gets one line for each shard.

    Raises:
        PluginError: a process failed.
    """
    if missing_shards(directory, count) and workers > 1:
        processes = [
            subprocess.Popen([sys.executable, "-m", "rn_policy_cubes.record", str(directory), str(count), *share])
            for share in ([str(part), str(workers)] for part in range(workers))
        ]
        if any([process.wait() for process in processes]):  # noqa: C419 - all are to end
            raise PluginError("A process that makes demonstrations failed; its message is above.")
    for number in missing_shards(directory, count):
        _say_shard(directory, number, count, say)


def missing_shards(directory: Path, count: int) -> list[int]:
    """Numbers of the shards below `count` that are not there."""
    return [number for number in range(count) if not shard_files(directory, number)[0].exists()]


def _say_shard(directory: Path, number: int, count: int, say: Say) -> None:
    lifted, episodes = write_shard(directory, number)
    say(f"demonstrations {number + 1}/{count}: {lifted} of {episodes} episodes lifted the cube")


def _main(directory: str, count: str, part: str, parts: str) -> None:
    for number in missing_shards(Path(directory), int(count)):
        if number % int(parts) == int(part):
            _say_shard(Path(directory), number, int(count), print)


if __name__ == "__main__":
    _main(*sys.argv[1:])
