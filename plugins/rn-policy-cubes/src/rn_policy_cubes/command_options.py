"""Options that several subcommands of `roboneuron policy cubes` share, and their values."""

from __future__ import annotations

import json
import os
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roboneuron import ConfigurationError


def add_settings(parser: ArgumentParser, example: str = "steps=500") -> None:
    """Add `--set`, repeatable."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"set a value of the recipe: {example}",
    )


def add_threads(parser: ArgumentParser) -> None:
    """Add `--threads`."""
    parser.add_argument(
        "--threads", type=int, default=1, help="threads of the training on a CPU (default: 1)"
    )


def add_computing(parser: ArgumentParser) -> None:
    """Add the options of how a training computes."""
    add_threads(parser)
    parser.add_argument(
        "--fuse", action="store_true", help="compile the layers: half the time; needs C++"
    )


def add_training(parser: ArgumentParser, directory: Path) -> None:
    """Add the options of a training that is continued, by default in `directory`."""
    add = parser.add_argument
    add("--out", type=Path, default=directory, help="default: %(default)s")
    add("--data", type=Path, help="folder of the demonstrations; default: OUT/demonstrations")
    add_settings(parser)
    add("--until", type=int, metavar="STEP", help="stop at this step, to continue later")
    add("--workers", type=int, default=1, help="processes that make demonstrations (default: 1)")
    add_computing(parser)


def add_packing(parser: ArgumentParser, directory: Path) -> None:
    """Add the options of `pack`."""
    add = parser.add_argument
    add("--out", type=Path, default=directory, help="folder of the training")
    add("--to", type=Path, required=True, metavar="FILE", help="the packed file")


def add_unpacking(parser: ArgumentParser) -> None:
    """Add the options of `unpack`."""
    add = parser.add_argument
    add("directory", type=Path, help="a new or empty folder")
    add("--weights", type=Path, help="a packed file; default: the one in this package")


def use_threads(count: int) -> None:
    """Set the number of PyTorch's threads in this process, which has not computed yet."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    import torch

    torch.set_num_threads(count)


def say(line: str) -> None:
    """Print immediately, also into a file or a pipe."""
    print(line, flush=True)


def told_settings(settings: list[str]) -> dict[str, object]:
    """Values by name of `--set` options. Raises ConfigurationError."""
    values: dict[str, object] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"--set {setting} does not have the form NAME=VALUE.")
        try:
            values[name] = json.loads(value)
        except ValueError:
            values[name] = value
    return values


@contextmanager
def values_checked() -> Iterator[None]:
    """Raise ConfigurationError for a value that a recipe or plan made within refuses."""
    from pydantic import ValidationError

    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        raise ConfigurationError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}.") from None


def data_of(arguments: Namespace) -> Path:
    """Folder of the demonstrations of a training."""
    return Path(arguments.data or arguments.out / "demonstrations")
