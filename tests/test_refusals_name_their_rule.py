"""Every refusal of a tool call names its rule."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
NAMED_BY_THE_GATE = {
    "roboneuron/gate/motion/joint_paths.py",
    *(
        f"roboneuron/direct_path/{name}.py"
        for name in ("gate", "limits", "plan_scenes", "places", "plans", "regions", "twists")
    ),
}
"""Rules of the gate raise without a name, because the gate adds the name of the applied rule."""
NO_TOOLS = "lerobot-robot-roboneuron"
"""Runs in a separate process, without tools."""


def unnamed() -> list[str]:
    found = []
    for path in [*ROOT.glob("plugins/*/src/**/*.py"), *ROOT.glob("roboneuron-core/src/**/*.py")]:
        place = path.relative_to(ROOT).as_posix()
        if NO_TOOLS in place or any(place.endswith(name) for name in NAMED_BY_THE_GATE):
            continue
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "RefusedError" in text else ():
            if not isinstance(node, ast.Call) or ast.unparse(node.func) != "RefusedError":
                continue
            if not any(keyword.arg == "rule" for keyword in node.keywords):
                found.append(f"{place}:{node.lineno}")
    return found


def test_every_refusal_outside_the_gate_names_its_rule() -> None:
    assert unnamed() == []
