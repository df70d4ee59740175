"""Count the licences in a CycloneDX bill of materials, and refuse packages that would bind users of
this project to publish their own code.

    python tools/licences.py out/release/roboneuron-0.1.0.cdx.json

The wheels of ROS name none in their metadata; their sources are under Apache-2.0 and BSD licences.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_BINDING = re.compile(r"\bA?GPL|(?<!Lesser )General Public License")


def named(component: dict[str, Any]) -> list[str]:
    """The licences of a component: SPDX identifiers and expressions, or names where it has none."""
    found = []
    for entry in component.get("licenses", []):
        licence = entry.get("license", {})
        found.append(entry.get("expression") or licence.get("id") or licence.get("name", ""))
    # a classifier repeats what an identifier says better, and some give a licence's whole text
    short = [one for one in found if not one.startswith("License ::") and len(one) < 100]
    return short or [one[:80] for one in found]


def is_binding(licences: Iterable[str]) -> bool:
    """True if there is no choice of another licence."""
    choices = [one for licence in licences for one in licence.split(" OR ")]
    return bool(choices) and all(_BINDING.search(one) for one in choices)


def main(words: list[str]) -> int:
    """Print the table; returns 1 if a package is binding."""
    components = json.loads(Path(words[0]).read_text(encoding="utf-8"))["components"]
    table: dict[str, list[str]] = {}
    for component in components:
        table.setdefault(", ".join(named(component)) or "none named", []).append(component["name"])
    for licence, names in sorted(table.items(), key=lambda row: -len(row[1])):
        print(f"{len(names):4}  {licence}: {', '.join(sorted(names)[:12])}")
    binding = [one["name"] for one in components if is_binding(named(one))]
    print(f"{len(components)} packages; binding: {', '.join(binding) or 'none'}")
    return 1 if binding else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
