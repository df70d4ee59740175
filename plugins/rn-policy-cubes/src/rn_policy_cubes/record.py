"""Recording of all demonstrations of a recipe, by several processes."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from rn_policy_cubes.demonstrations import VIEWS, shard_files, write_shard
from rn_policy_cubes.progress import Progress, Say
from roboneuron import PluginError

_POLL_S = 1.0


def record(directory: Path, count: int, *, workers: int, say: Say, views: int = VIEWS) -> None:
    """Create the missing shards below `count`.

    Args:
        directory: folder of the shards.
        count: total number of shards.
        workers: number of processes.
        say: called with the progress every 10 s.
        views: views of each shard.

    Raises:
        PluginError: a process failed.
    """
    missing = missing_shards(directory, count)
    if not missing:
        return
    say(
        f"demonstrations: {count - len(missing)} of {count} shards exist, {len(missing)} of "
        f"{views} views are created"
    )
    progress = Progress("demonstrations: views", count * views, (count - len(missing)) * views, say)
    if workers > 1:
        _record_by_several(directory, count, workers, views, progress)
    lifted, episodes = 0, 0
    for number in missing_shards(directory, count):
        before = (count - len(missing_shards(directory, count))) * views
        figures = f"{lifted} of {episodes} episodes lifted the cube" if episodes else ""
        more = write_shard(directory, number, views, _counted(progress, before, figures))
        lifted, episodes = lifted + more[0], episodes + more[1]


def _counted(progress: Progress, before: int, figures: str) -> Callable[[int], object]:
    return lambda made: progress.update(before + made, figures)


def _record_by_several(
    directory: Path, count: int, workers: int, views: int, progress: Progress
) -> None:
    """Create them in processes; the progress counts finished shards."""
    command = [
        sys.executable,
        "-P",
        "-m",
        "rn_policy_cubes.record",
        str(directory),
        str(count),
        str(views),
    ]
    processes = [subprocess.Popen([*command, str(part), str(workers)]) for part in range(workers)]
    while any(process.poll() is None for process in processes):
        with suppress(subprocess.TimeoutExpired):
            next(process for process in processes if process.poll() is None).wait(_POLL_S)
        progress.update((count - len(missing_shards(directory, count))) * views)
    if any(process.returncode for process in processes):
        raise PluginError("A process that records demonstrations failed; its message is above.")


def missing_shards(directory: Path, count: int) -> list[int]:
    """Numbers of the missing shards below `count`."""
    return [number for number in range(count) if not shard_files(directory, number)[0].exists()]


def _main(directory: str, count: str, views: str, part: str, parts: str) -> None:
    for number in missing_shards(Path(directory), int(count)):
        if number % int(parts) == int(part):
            write_shard(Path(directory), number, int(views))


if __name__ == "__main__":
    _main(*sys.argv[1:])
