"""Terminal screenshots for the documentation: real output of RoboNeuron's commands, as SVG.

    python tools/terminal_pictures.py               create all of them in docs/assets (five minutes)
    python tools/terminal_pictures.py doctor tools  only these

Each command runs in a pseudo-terminal, in its own folder and with its own state directory. In the
images `~` stands for that folder and for the home folder, `roboneuron` for the source folder.
"""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rich._export_format import CONSOLE_SVG_FORMAT
from rich.console import Console
from rich.text import Text

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "docs" / "assets"
BIN = Path(sys.executable).parent
LONGEST_S = 300.0
# Pages load nothing from another host, fonts included.
FORMAT = re.sub(r"@font-face \{\{.*?\}\}", "", CONSOLE_SVG_FORMAT, flags=re.DOTALL).replace(
    "Fira Code", "DejaVu Sans Mono"
)
CONFIGURATION = """\
[robot]
name = "fr3"

[perception]
source = "fr3-sim-camera"

[inference]
backend = "servo"

[control]
controller = "urdf"

[recorder]
record = true
"""
MISTAKEN = '[robot]\nname = "fr3"\ndrivr = "simulated"\n'
EVALUATION = "roboneuron eval run --episodes 8 --seed 3 --threads 2 --out out/eval --strips none"


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """An image of commands and their output.

    Attributes:
        commands: shown with a prompt, run in this order.
        before: commands run before and not shown.
        first, last: number of output lines shown; 0 for all.
        columns: width of the terminal.
        fails: the last command is expected to fail; any other failure is an error.
        animated: the commands redraw their output; it is shown as if written to a file.
        beside: a command that runs meanwhile, once `roboneuron status` finds nothing wrong.
    """

    commands: tuple[str, ...]
    before: tuple[str, ...] = ()
    first: int = 0
    last: int = 0
    columns: int = 96
    beside: str = ""
    animated: bool = False
    fails: bool = False


PICTURES = {
    "demo": Picture(commands=("roboneuron demo --seed 7",), columns=100, animated=True),
    "run": Picture(commands=('roboneuron run "pick up the red cube"',), columns=84, animated=True),
    "tools": Picture(commands=("roboneuron tools",), first=24, columns=118),
    "config-check": Picture(
        commands=("cat mistaken.toml", "roboneuron config check mistaken.toml"), fails=True
    ),
    "doctor": Picture(commands=("roboneuron doctor",), columns=110),
    "describe": Picture(commands=("roboneuron ros describe geometry_msgs/msg/Twist",), columns=110),
    "plugins-list": Picture(commands=("roboneuron plugins list",), columns=84),
    "plugins-show": Picture(commands=("roboneuron plugins show servo",), columns=110),
    "plugins-rules": Picture(
        commands=("roboneuron plugins rules acceleration",), last=21, columns=100
    ),
    "plugins-check": Picture(commands=("roboneuron plugins check servo",), last=20),
    "new": Picture(
        commands=("roboneuron plugins new backend nod", "find rn-backend-nod -type f"), columns=90
    ),
    "status": Picture(
        commands=("roboneuron status", "roboneuron estop --status"),
        beside="roboneuron up --config roboneuron.toml --instruction 'pick up the red cube'",
    ),
    "logs": Picture(
        before=("roboneuron run --config roboneuron.toml 'pick up the red cube'",),
        commands=("roboneuron logs",),
        first=12,
        columns=150,
    ),
    "runs": Picture(
        before=("roboneuron run --config roboneuron.toml 'pick up the red cube'",),
        commands=("roboneuron runs list", "roboneuron runs show latest"),
        columns=116,
        first=22,
    ),
    "estop": Picture(
        commands=(
            "roboneuron estop --reason 'a person is in the cell'",
            "roboneuron estop --reset",
        ),
        columns=124,
        fails=True,
    ),
    "eval": Picture(
        before=(EVALUATION,), commands=("roboneuron eval report out/eval --by target",), columns=96
    ),
    "fr3-check": Picture(commands=("roboneuron robot fr3 check",), columns=104, fails=True),
}


def run(command: str, folder: Path, columns: int) -> tuple[str, int]:
    """Run a command on its own terminal; return its output and exit status.

    Raises:
        TimeoutError: it did not end within five minutes.
    """
    parent, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 200, columns, 0, 0))
    process = subprocess.Popen(
        ["bash", "-o", "pipefail", "-c", command],
        cwd=folder,
        env=environment(folder),
        stdin=subprocess.DEVNULL,
        stdout=child,
        stderr=child,
        start_new_session=True,
    )
    os.close(child)
    end, printed = time.monotonic() + LONGEST_S, b""
    try:
        while time.monotonic() < end:
            try:
                part = os.read(parent, 65536)
            except OSError:  # raised by Linux when the last writer has closed
                break
            if not part:
                break
            printed += part
        else:
            raise TimeoutError(f"{command!r} did not end within {LONGEST_S:g} s")
    finally:
        os.close(parent)
        if time.monotonic() >= end:
            process.terminate()
        process.wait(30)
    return printed.decode(errors="replace").replace("\r\n", "\n"), process.returncode


def environment(folder: Path) -> dict[str, str]:
    """Environment of the commands: their own state directory, only sixteen colours."""
    changed = {
        "PATH": f"{BIN}:{os.environ['PATH']}",
        "XDG_STATE_HOME": str(folder / ".local" / "state"),
        "TERM": "xterm",
    }
    return {k: v for k, v in os.environ.items() if k not in ("COLORTERM", "NO_COLOR")} | changed


@contextmanager
def running(command: str, folder: Path) -> Iterator[None]:
    """Run a command in the background; entered when `roboneuron status` finds nothing wrong."""
    if not command:
        yield
        return
    process = subprocess.Popen(
        ["bash", "-c", f"exec {command}"],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        end = time.monotonic() + LONGEST_S
        ask = [str(BIN / "roboneuron"), "status", "--config", "roboneuron.toml"]
        while subprocess.run(
            ask, cwd=folder, env=environment(folder), capture_output=True, check=False
        ).returncode:
            if time.monotonic() > end or process.poll() is not None:
                raise RuntimeError(f"{command!r} did not come up")
        yield
    finally:
        process.terminate()
        process.wait(60)


def make(name: str, picture: Picture) -> None:
    """Run the commands of an image and write it."""
    with tempfile.TemporaryDirectory(prefix="pictures-") as scratch:
        folder = Path(scratch)
        (folder / "roboneuron.toml").write_text(CONFIGURATION, encoding="utf-8")
        (folder / "mistaken.toml").write_text(MISTAKEN, encoding="utf-8")
        lines: list[str] = []
        for command in picture.before:
            run(command, folder, picture.columns)
        with running(picture.beside, folder):
            for command in picture.commands:
                asked = f"{command} | cat" if picture.animated else command
                printed, status = run(asked, folder, picture.columns)
                if (status != 0) != (picture.fails and command is picture.commands[-1]):
                    raise RuntimeError(f"{command!r} ended with status {status}:\n{printed}")
                for path, short in (
                    (scratch, "~"),
                    (str(ROOT), "roboneuron"),
                    (str(Path.home()), "~"),
                ):
                    printed = printed.replace(path, short)
                lines += [f"\x1b[1;32m$\x1b[0m \x1b[1m{command}\x1b[0m", *shown(printed, picture)]
    console = Console(record=True, width=picture.columns, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(Text.from_ansi("\n".join(lines)))
    target = ASSETS / f"cast-{name}.svg"
    # remove an id that changes with each run
    svg = console.export_svg(title="", code_format=FORMAT, unique_id=f"cast-{name}")
    target.write_text(svg, encoding="utf-8")
    print(f"{target.relative_to(ROOT)}: {len(lines)} lines, {len(svg) // 1000} kB")


def shown(printed: str, picture: Picture) -> list[str]:
    """The lines of one command shown in the image."""
    # of a redrawn line only its last version counts
    lines = [line.rpartition("\r")[2].rstrip() for line in printed.rstrip("\n").split("\n")]
    if picture.first and len(lines) > picture.first:
        return [*lines[: picture.first], "\x1b[2m...\x1b[0m"]
    if picture.last and len(lines) > picture.last:
        return ["\x1b[2m...\x1b[0m", *lines[-picture.last :]]
    return lines


def main(names: list[str]) -> int:
    """Create the images of these names, or all."""
    unknown = set(names) - PICTURES.keys()
    if unknown:
        print(f"There is no picture {sorted(unknown)}; there are: {', '.join(PICTURES)}.")
        return 2
    for name in names or PICTURES:
        make(name, PICTURES[name])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
