"""Build every distribution twice, compare, and check what would be published.

    python tools/release.py out/release/dist                              # build and check
    python tools/release.py out/release/dist --revision v0.1.0            # of another commit
    python tools/release.py out/release/before --renumber 0.0.1 --whole   # to upgrade from

Built is what a commit has, not the working tree: source distributions and wheels from an export of
it, then the wheels again from the unpacked source distributions in another folder. Equal bytes show
that a source distribution is complete and that nothing of this machine gets into a wheel. Their
times are those of the commit (SOURCE_DATE_EPOCH). Nothing is uploaded.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import distributions
import requirements

ROOT = Path(__file__).parents[1]
EXPECTED = {"roboneuron": "W007,W008,W009", "rn_testing": "W002,W009"}
"""Findings of check-wheel-contents that are meant: the whole holds no code, and the templates of
`roboneuron plugins new` contain the licence a second time.
"""
_OTHERS = "W009"
"""Some distributions have several packages, which load apart."""


def export(revision: str, folder: Path) -> None:
    """Lay the files of a commit into an empty folder."""
    folder.mkdir(parents=True)
    archive = folder.with_suffix(".tar")
    _run(["git", "archive", "--output", str(archive), revision], ROOT)
    _unpack(archive, folder)
    archive.unlink()


def build(folder: Path, out: Path, epoch: int, targets: Sequence[str]) -> None:
    """Build one distribution; `targets` are of hatchling."""
    words = [word for target in targets for word in ("-t", target)]
    command = [sys.executable, "-m", "hatchling", "build", *words, "-d", str(out)]
    _run(command, folder, {"SOURCE_DATE_EPOCH": str(epoch)})


def build_all(sources: Path, out: Path, epoch: int, folders: Sequence[Path]) -> None:
    """Build source distributions and wheels into an empty folder."""
    out.mkdir(parents=True)
    for folder in folders:
        print(f"  {folder.relative_to(sources)}", flush=True)
        build(folder, out, epoch, ("sdist", "wheel"))


def rebuild_wheels(first: Path, scratch: Path, epoch: int) -> Path:
    """Build the wheels again, from the source distributions alone; returns their folder."""
    again = scratch / "again"
    for archive in sorted(first.glob("*.tar.gz")):
        unpacked = scratch / "unpacked"
        unpacked.mkdir()
        _unpack(archive, unpacked)
        (folder,) = unpacked.iterdir()
        build(folder, again, epoch, ("wheel",))
        shutil.rmtree(unpacked)
    return again


def differing(first: Path, again: Path) -> list[str]:
    """Names of wheels that are not equal to the bit, or missing in one folder."""
    one, other = ({path.name: path for path in sorted(f.glob("*.whl"))} for f in (first, again))
    return [
        name
        for name in sorted(one.keys() | other.keys())
        if name not in one
        or name not in other
        or one[name].read_bytes() != other[name].read_bytes()
    ]


def faults_of_contents(folder: Path) -> Iterator[str]:
    """What check-wheel-contents and twine find."""
    wheels = sorted(folder.glob("*.whl"))
    groups: dict[str, list[str]] = {}
    for wheel in wheels:
        ignored = EXPECTED.get(wheel.name.partition("-")[0], _OTHERS)
        groups.setdefault(ignored, []).append(str(wheel))
    commands = [
        ["check_wheel_contents", "--no-config", "--ignore", ignored, *names]
        for ignored, names in groups.items()
    ]
    commands.append(["twine", "check", "--strict", *map(str, sorted(folder.iterdir()))])
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", *command], capture_output=True, text=True, check=False
        )
        if done.returncode:
            lines = (done.stdout + done.stderr).splitlines()
            yield "\n".join(line for line in lines if not line.endswith((": OK", "PASSED")))


def write_sums(folder: Path) -> None:
    """SHA256SUMS beside the folder, as `sha256sum --check` reads it."""
    lines = [
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {folder.name}/{path.name}\n"
        for path in sorted(folder.iterdir())
    ]
    (folder.parent / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def _unpack(archive: Path, folder: Path) -> None:
    with tarfile.open(archive) as files:
        files.extractall(folder, filter="data")


def _run(command: list[str], folder: Path, more: dict[str, str] | None = None) -> str:
    environment = {**os.environ, **(more or {})}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(f"{' '.join(command)} in {folder}:\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def main(words: list[str]) -> int:
    """Build and check; returns 1 if something is not as it must be."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--revision", default="HEAD", help="commit that is built")
    parser.add_argument("--renumber", help="build as this version, once and unchecked")
    parser.add_argument("--whole", action="store_true", help="only what `roboneuron` needs")
    arguments = parser.parse_args(words)
    out = arguments.out.resolve()
    shutil.rmtree(out, ignore_errors=True)
    epoch = int(_run(["git", "log", "-1", "--format=%ct", arguments.revision], ROOT))
    with tempfile.TemporaryDirectory(prefix="rn-release-") as name:
        scratch = Path(name)
        sources = scratch / "sources"
        export(arguments.revision, sources)
        if arguments.renumber:
            distributions.set_version(arguments.renumber, sources)
        folders = distributions.projects(sources)
        if arguments.whole:
            needs = distributions.facts_of(sources)["dependencies"]
            wanted = {distributions.WHOLE, *requirements.closure(needs, sources)}
            folders = [one for one in folders if distributions.facts_of(one)["name"] in wanted]
        print(f"{len(folders)} distributions of {arguments.revision}:", flush=True)
        build_all(sources, out, epoch, folders)
        if arguments.renumber:
            return 0
        print("the wheels again, from the source distributions", flush=True)
        found = [
            f"{one} is another file when built again"
            for one in differing(out, rebuild_wheels(out, scratch, epoch))
        ]
    found += [*distributions.faults(), *faults_of_contents(out)]
    write_sums(out)
    print("\n".join(found) or f"{out}: {len(folders)} distributions, built twice and checked")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
