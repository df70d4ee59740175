"""Check what all distributions of the repository share: version, ranges of each other, metadata.

    python tools/distributions.py                  # a line for each fault; exit status 1 if any
    python tools/distributions.py --version 0.1.1  # set the version everywhere
    python tools/distributions.py --url URL        # set the address of the project everywhere
    python tools/distributions.py --tag v0.1.0     # check also what a tagged release needs

A version is written in each pyproject.toml, so that a source distribution is complete by itself.
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
WHOLE = "roboneuron"
CORE = "roboneuron-core"
_VERSION = re.compile(r'^(__version__|version) = "([^"]+)"$', re.MULTILINE)
_OWN = re.compile(
    r'"((?:roboneuron-core|rn-[a-z0-9-]+)(?:\[[a-z0-9,-]+\])?)>=([0-9.]+),<([0-9.]+)"'
)
_URLS = re.compile(r"\n\[project\.urls\]\n(?:.+\n)*")
_PAGES = {"Source": "", "Issues": "/issues", "Changelog": "/blob/main/CHANGELOG.md"}
_CLASSIFIERS = ("Development Status :: 4 - Beta", "Operating System :: POSIX :: Linux")


def projects(root: Path = ROOT) -> list[Path]:
    """Folders of the distributions: core, plugins, then the one at the root."""
    plugins = sorted(path.parent for path in root.glob("plugins/*/pyproject.toml"))
    return [root / CORE, *plugins, root]


def facts_of(folder: Path) -> dict[str, Any]:
    """The table `project` of a distribution."""
    text = (folder / "pyproject.toml").read_text(encoding="utf-8")
    facts: dict[str, Any] = tomllib.loads(text)["project"]
    return facts


def version_of(root: Path = ROOT) -> str:
    """The version of core, which is that of all."""
    return str(facts_of(root / CORE)["version"])


def next_minor(version: str) -> str:
    """The first version that may break: 0.2 for 0.1.3."""
    major, minor, *_ = version.split(".")
    return f"{major}.{int(minor) + 1}"


def faults(root: Path = ROOT) -> Iterator[str]:
    """What differs between the distributions, or is missing in one."""
    version = version_of(root)
    module = root / CORE / "src" / "roboneuron" / "__init__.py"
    if f'__version__ = "{version}"\n' not in module.read_text(encoding="utf-8"):
        yield f"{module.relative_to(root)}: __version__ is not {version}"
    addresses = set()
    for folder in projects(root):
        facts = facts_of(folder)
        place = (folder / "pyproject.toml").relative_to(root)
        if facts["version"] != version:
            yield f"{place}: version is {facts['version']}, of core {version}"
        text = (folder / "pyproject.toml").read_text(encoding="utf-8")
        for name, floor, cap in _OWN.findall(text):
            if not _is_same(floor, version) or cap != next_minor(version):
                want = f">={version},<{next_minor(version)}"
                yield f"{place}: {name}>={floor},<{cap}, expected {want}"
        if not (folder / "LICENSE").is_file():
            yield f"{place}: no LICENSE beside it"
        missing = [line for line in _CLASSIFIERS if line not in facts["classifiers"]]
        if missing:
            yield f"{place}: classifiers lack {', '.join(missing)}"
        untyped = [
            path.name
            for path in sorted((folder / "src").glob("*"))
            if (path / "__init__.py").exists() and not (path / "py.typed").exists()
        ]
        if untyped:
            yield f"{place}: no py.typed in {', '.join(untyped)}"
        addresses.add(str(facts.get("urls")))
    if len(addresses) != 1:
        yield "project.urls differ: run with --url"


def faults_of_tag(tag: str, root: Path = ROOT) -> Iterator[str]:
    """What keeps the present state from being released as `tag`."""
    version = version_of(root)
    if tag != f"v{version}":
        yield f"the tag {tag} does not name the version {version}"
    if not re.search(rf"^## {re.escape(version)}\b", _changelog(root), re.MULTILINE):
        yield f"CHANGELOG.md has no heading of {version}"
    if "urls" not in facts_of(root):
        yield "no project.urls: run with --url and the public address of the repository"


def _changelog(root: Path) -> str:
    return (root / "CHANGELOG.md").read_text(encoding="utf-8")


def _is_same(one: str, other: str) -> bool:
    """True for 0.1 and 0.1.0."""
    return re.sub(r"(\.0)+$", "", one) == re.sub(r"(\.0)+$", "", other)


def set_version(version: str, root: Path = ROOT) -> None:
    """Write the version of all distributions, and the ranges in which they accept each other.

    The floors rise with it, because `pip install --upgrade roboneuron` upgrades only what the old
    version does not satisfy.
    """
    files = [folder / "pyproject.toml" for folder in projects(root)]
    for file in (*files, root / CORE / "src" / "roboneuron" / "__init__.py"):
        text = file.read_text(encoding="utf-8")
        text = _VERSION.sub(rf'\1 = "{version}"', text, count=1)
        text = _OWN.sub(rf'"\1>={version},<{next_minor(version)}"', text)
        file.write_text(text, encoding="utf-8")


def set_url(url: str, root: Path = ROOT) -> None:
    """Write the links of all distributions from the public address of the repository."""
    lines = "".join(f'{name} = "{url.rstrip("/")}{path}"\n' for name, path in _PAGES.items())
    for folder in projects(root):
        file = folder / "pyproject.toml"
        head, mark, tail = _URLS.sub("", file.read_text(encoding="utf-8")).partition("\n[tool.")
        file.write_text(f"{head}\n[project.urls]\n{lines}{mark}{tail}", encoding="utf-8")


def main(words: list[str]) -> int:
    """Set what is asked for, then check; returns 1 if something differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--version", help="set it everywhere")
    parser.add_argument("--url", help="set the address of the project everywhere")
    parser.add_argument("--tag", help="check also what a release of this tag needs")
    arguments = parser.parse_args(words)
    if arguments.version:
        set_version(arguments.version)
    if arguments.url:
        set_url(arguments.url)
    found = [*faults(), *(faults_of_tag(arguments.tag) if arguments.tag else ())]
    print("\n".join(found) or f"{len(projects())} distributions, version {version_of()}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
