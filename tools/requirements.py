"""Write requirements.txt: the packages of this checkout that the distribution `roboneuron` needs,
as folders.

    python tools/requirements.py            # write it, and requirements-EXTRA.txt for each extra
    python tools/requirements.py --check    # exit status 1 if one of them is not current

pip installs a package given by its folder from there, and never looks up its name on an index. So
these files contain every package of the project, including indirect requirements.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
WHOLE = "roboneuron"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def folders(root: Path = ROOT) -> dict[str, Path]:
    """Folder of each package of the project by its name, except the one at the root."""
    files = [
        root / "roboneuron-core" / "pyproject.toml",
        *sorted(root.glob("plugins/*/pyproject.toml")),
    ]
    return {_project(path)["name"]: path.parent for path in files}


def closure(needs: Iterable[str], root: Path = ROOT) -> list[str]:
    """Names of the project's packages among `needs` (as requirements), and of those that they
    require.
    """
    known, found, waiting = folders(root), set[str](), list(needs)
    while waiting:
        match = _NAME.match(waiting.pop())
        if match is not None and match[0] in known and match[0] not in found:
            found.add(match[0])
            waiting += _project(known[match[0]] / "pyproject.toml")["dependencies"]
    return [name for name in known if name in found]


def texts() -> dict[str, str]:
    """Expected content of each file, by name."""
    root = _project(ROOT / "pyproject.toml")
    common = closure(root["dependencies"])
    made = {
        "requirements.txt": [
            "# The whole from this checkout; run pip in this folder. Written by "
            "tools/requirements.py.",
            "--constraint constraints.txt",
            *_paths(common),
        ]
    }
    for extra, needs in root.get("optional-dependencies", {}).items():
        made[f"requirements-{extra}.txt"] = [
            f"# What `{WHOLE}[{extra}]` needs besides requirements.txt. Written by "
            "tools/requirements.py.",
            "# Without constraints: pip keeps the build of PyTorch that is installed.",
            *_paths(name for name in closure(needs) if name not in common),
        ]
    return {name: "\n".join(lines) + "\n" for name, lines in made.items()}


def _paths(names: Iterable[str]) -> list[str]:
    known = folders()
    return [f"./{known[name].relative_to(ROOT)}" for name in names]


def _project(path: Path) -> dict[str, Any]:
    facts: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))["project"]
    return facts


def main(arguments: list[str]) -> int:
    """Write the files, or compare them with the expected content."""
    status = 0
    for name, text in texts().items():
        file = ROOT / name
        if arguments == ["--check"]:
            if not file.exists() or file.read_text(encoding="utf-8") != text:
                print(f"{name} is not current, run: python tools/requirements.py")
                status = 1
        else:
            file.write_text(text, encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
