"""RoboNeuron from a folder of wheels alone, on each Python: install, upgrade, use, uninstall.

    python tests/pythons/wheels.py FOLDER [--before OLDER] [--sbom FILE] PYTHON ...

FOLDER and OLDER hold wheels of this project. Packages of others are installed first, from the
index; the project's own with `--no-index`, because somebody else may have their names there. In a
fresh environment per interpreter: `pip install --upgrade` from the wheels in OLDER leaves nothing
of them; `roboneuron serve` answers an MCP client, `run` and `demo` lift a cube, and what is not
installed is named with a command for wheels; `pip uninstall` leaves nothing. Exit status 0 means
that everything worked everywhere.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from email.parser import HeaderParser
from pathlib import Path

from check import INSTALL_LIMIT_S, NOT_COMPILED, ROOT, RUN_LIMIT_S, clean_environment, run
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

WHOLE = "roboneuron"
NOT_INSTALLED = ("eval", "rn-eval")
"""A command, and the package that brings it; not among those of `roboneuron`."""
INSTALLED = """
import json
from importlib.metadata import distributions
found = {d.metadata["Name"].lower().replace("_", "-"): d.version for d in distributions()}
print(json.dumps(found))
"""
LEFT = """
import json, sysconfig
from pathlib import Path
paths = {sysconfig.get_path(name) for name in ("purelib", "platlib", "scripts")}
patterns = ("rn_*", "rn-*", "roboneuron*")
print(json.dumps([str(found) for p in paths for one in patterns for found in Path(p).glob(one)]))
"""


def requirements_of(wheel: Path) -> list[Requirement]:
    """What a wheel requires without its extras."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        headers = HeaderParser().parsestr(archive.read(name).decode())
    found = [Requirement(text) for text in headers.get_all("Requires-Dist", [])]
    return [one for one in found if "extra ==" not in str(one.marker)]


def closure(folder: Path) -> tuple[dict[str, str], list[str]]:
    """The project's own packages that `roboneuron` needs, with their versions, and the requirements
    on packages of others.
    """
    wheels = {parse_wheel_filename(path.name)[0]: path for path in folder.glob("*.whl")}
    own, others, waiting = dict[str, str](), set[str](), [canonicalize_name(WHOLE)]
    while waiting:
        name = waiting.pop()
        own[name] = str(parse_wheel_filename(wheels[name].name)[1])
        for need in requirements_of(wheels[name]):
            wanted = canonicalize_name(need.name)
            if wanted not in wheels:
                others.add(str(need))
            elif wanted not in own:
                waiting.append(wanted)
    return own, sorted(others)


class Installation:
    """A fresh environment with the packages that others made."""

    def __init__(self, interpreter: str, folder: Path, others: Sequence[str]) -> None:
        self._folder = folder
        self._environment = clean_environment(folder)
        run([interpreter, "-m", "venv", str(folder / "venv")], folder, 300, self._environment)
        self.python = folder / "venv/bin/python"
        limits = ["--only-binary", NOT_COMPILED, "--constraint", str(ROOT / "constraints.txt")]
        self.pip("install", *limits, *others)

    def pip(self, verb: str, *words: str) -> None:
        """Run pip; it ends the check if it fails."""
        quiet = ("--quiet", "--disable-pip-version-check")
        command = [str(self.python), "-m", "pip", verb, *quiet, *words]
        run(command, self._folder, INSTALL_LIMIT_S, self._environment)

    def ask(self, code: str) -> object:
        """What a line of Python prints, as JSON."""
        command = [str(self.python), "-c", code]
        answer: object = json.loads(run(command, self._folder, 60, self._environment))
        return answer

    def roboneuron(self, *words: str) -> str:
        """Run the command; it ends the check if it fails."""
        command = [str(self.python.parent / "roboneuron"), *words]
        return run(command, self._folder, RUN_LIMIT_S, self._environment)

    def refusal(self, *words: str) -> str:
        """What the command says when it refuses."""
        command = [str(self.python.parent / "roboneuron"), *words]
        done = subprocess.run(
            command,
            cwd=self._folder,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.stderr if done.returncode == os.EX_USAGE or done.returncode == 2 else ""


def expect_installed(installation: Installation, own: dict[str, str]) -> None:
    """The project's packages are these, in these versions."""
    found = installation.ask(INSTALLED)
    assert isinstance(found, dict)
    ours = {n: v for n, v in found.items() if n.startswith(("rn-", WHOLE))}
    if ours != own:
        sys.exit(f"installed are {ours}, expected {own}")


def install(installation: Installation, folder: Path) -> None:
    """Install `roboneuron` from a folder alone, or upgrade to what is there."""
    installation.pip("install", "--no-index", "--find-links", str(folder), "--upgrade", WHOLE)
    expect_installed(installation, closure(folder)[0])
    installation.pip("check")


def use(installation: Installation) -> None:
    """The commands of the README's first minutes."""
    installation.roboneuron("doctor")
    status = installation.roboneuron("call", "get_status")
    if "emergency" not in status:
        sys.exit(f"the server's status names no emergency stop:\n{status}")
    installation.roboneuron("run", "pick up the red cube")
    installation.roboneuron("demo", "--seed", "1")
    command, package = NOT_INSTALLED
    said = installation.refusal(command)
    if not re.search(rf"pip install --find-links \S+ {package}\b", said) or "plugins/" in said:
        sys.exit(f"`roboneuron {command}` gives no command for wheels:\n{said}")


def uninstall(installation: Installation, own: dict[str, str]) -> None:
    """Nothing of the project is left behind."""
    installation.pip("uninstall", "--yes", *own)
    left = installation.ask(LEFT)
    if left:
        sys.exit(f"left after pip uninstall: {left}")


def check(interpreter: str, folder: Path, before: Path | None, sbom: Path | None) -> str:
    """All steps with one interpreter; what was shown, in words."""
    own, others = closure(folder)
    with tempfile.TemporaryDirectory(prefix="rn-wheels-") as scratch:
        installation = Installation(interpreter, Path(scratch), others)
        upgraded = ""
        if before is not None:
            install(installation, before)
            upgraded = f"upgraded from {closure(before)[0][WHOLE]}, "
        install(installation, folder)
        if sbom is not None:
            words = ["environment", str(installation.python), "--output-reproducible"]
            words += ["--pyproject", str(ROOT / "pyproject.toml"), "--output-file", str(sbom)]
            run(["cyclonedx-py", *words], ROOT, 300, dict(os.environ))
        use(installation)
        uninstall(installation, own)
    return f"{upgraded}{len(own)} wheels installed, serve, run and demo work, uninstalled"


def absolute(text: str) -> Path:
    """A path that steps in other folders can use."""
    return Path(text).resolve()


def main() -> None:
    """Check every interpreter named on the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=absolute)
    parser.add_argument("--before", type=absolute, default=None)
    parser.add_argument("--sbom", type=absolute, default=None)
    parser.add_argument("pythons", nargs="+")
    arguments = parser.parse_args()
    sbom = arguments.sbom
    for interpreter in arguments.pythons:
        shown = check(interpreter, arguments.folder, arguments.before, sbom)
        print(f"{interpreter}: {shown}", flush=True)
        sbom = None


if __name__ == "__main__":
    main()
