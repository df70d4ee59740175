"""Draw the diagrams and plots of the documentation, docs/assets/*.svg, from the tables in this
module.

    python tools/diagrams.py           write them
    python tools/diagrams.py --check   exit status 1 unless the committed files are current

Numbers of plots come from benchmarks/results.toml. Each panel has its own background, so
that it is readable on light and dark pages. tools/process_figure.py draws processes.svg.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from diagram_plots import DOCS, plot_chunks, plot_fastv, plot_starts
from diagram_sheet import AMBER, BLUE, GREEN, RED, WHITE, Sheet


def packages() -> str:
    """Packages of the core in the order of their imports, and the plugins."""
    s = Sheet(900, 362, "Packages of the core and what they import")
    rows = (
        ("cli", BLUE), ("tools, switching", BLUE), ("direct_path, sight, selection, stdio", BLUE),
        ("server", BLUE), ("supervisor", BLUE), ("modules", AMBER), ("ros", AMBER),
        ("estop, gate", RED), ("plugins, planning, config", GREEN),
        ("contract", GREEN), ("errors", GREEN),
    )  # fmt: skip
    for number, (name, fill) in enumerate(rows):
        s.box(30, 16 + 30 * number, 300, 26, name, fill=fill)
    s.line((352, 30), (352, 332))
    s.text(364, 185, "imports go down only", small=True, anchor="start")
    s.box(
        540,
        40,
        330,
        66,
        "rn-standard",
        "tasks, ops, HTTP, teleoperation,",
        "simulate, fleet, console",
    )
    s.box(540, 122, 330, 50, "devices", "rn-robot-*, rn-perception-*, rn-controller-*")
    s.box(540, 188, 330, 50, "models", "rn-backend-*, rn-runtime-*, rn-accel-*")
    s.box(540, 252, 330, 34, "rn-recorder, rn-view, rn-eval, ...")
    s.line((540, 215), (515, 215), (515, 269), (332, 269))
    s.text(440, 287, "found by entry points", small=True)
    return s.svg()


def stops() -> str:
    """Layers that stop the arm, with their times."""
    s = Sheet(940, 300, "Each layer stops the arm by itself; times are defaults")
    s.box(
        30,
        70,
        180,
        104,
        "inference",
        "sends nothing if an",
        "input is older",
        "than 0.5 s",
        fill=AMBER,
    )
    s.box(
        270,
        70,
        180,
        104,
        "control",
        "holds without",
        "actions 0.5 s, joint",
        "states 0.25 s, server 2 s",
        fill=AMBER,
    )
    s.box(
        525,
        70,
        185,
        104,
        "robot module",
        "the driver brakes without",
        "commands 1 s,",
        "the server 2 s",
        fill=GREEN,
    )
    s.box(770, 70, 140, 104, "arm", "its own safety", "functions", fill=WHITE)
    for start, end, label in ((210, 270, "action"), (450, 525, "command"), (710, 770, "")):
        s.line((start, 122), (end, 122))
        s.text((start + end) / 2, 112, label, small=True)
    s.box(
        30,
        216,
        680,
        60,
        "emergency stop: a file, a topic, a signal, a tool, a command",
        "every process checks the file 50 times a second; only a person releases it",
        fill=RED,
    )
    for x in (120, 360, 617):
        s.line((x, 216), (x, 176))
    s.text(470, 40, "Each layer works even if everything left of it has failed.", bold=True)
    return s.svg()


def gate() -> str:
    """Path of an agent's message through the gate."""
    s = Sheet(940, 250, "A message of an agent passes the gate")
    s.box(30, 90, 120, 60, "agent", "publish, move", fill=WHITE)
    s.text(470, 36, "the gate: the first rule that fails refuses the message", bold=True)
    groups = (
        ("may it?", "allow list, role"), ("is it valid?", "type, finite"),
        ("within limits?", "bounds, path"), ("now?", "stop, rate, audit"),
    )  # fmt: skip
    for number, lines in enumerate(groups):
        s.box(190 + 145 * number, 80, 130, 80, *lines, fill=RED)
        s.line((150 if number == 0 else 175 + 145 * number, 120), (190 + 145 * number, 120))
    s.line((755, 120), (800, 120))
    s.box(800, 90, 110, 60, "ROS", "topic, service", fill=GREEN)
    s.line((470, 162), (470, 196))
    s.box(350, 196, 240, 38, "audit: each decision", fill=BLUE)
    s.line((350, 215), (90, 215), (90, 152), dashed=True)
    s.text(215, 206, "error: rule and reason", small=True)
    return s.svg()


def switch() -> str:
    """Timeline of a warm switch."""
    s = Sheet(940, 240, "A warm switch: the new module works in shadow, then takes over")
    s.text(60, 68, "old", bold=True)
    s.text(60, 138, "new", bold=True)
    s.bar(110, 48, 560, 34, AMBER)
    s.text(390, 70, "publishes")
    s.bar(110, 118, 210, 34, WHITE)
    s.text(215, 140, "starts, loads")
    s.bar(320, 118, 350, 34, BLUE)
    s.text(495, 140, "shadow: compared with the old one")
    s.bar(670, 118, 240, 34, AMBER)
    s.text(790, 140, "publishes")
    s.bar(670, 48, 90, 34, WHITE)
    s.text(715, 70, "ends")
    s.line((670, 176), (670, 30), head=False, dashed=True)
    s.text(670, 22, "handover time", small=True)
    s.text(560, 184, "inputs stamped before: old", small=True)
    s.text(790, 184, "inputs stamped later: new", small=True)
    s.line((110, 204), (910, 204))
    s.text(900, 224, "time", small=True)
    return s.svg()


def chunks() -> str:
    """Timeline of sequential and overlapped execution, with chunks of 8 rows and a latency of 3."""
    s = Sheet(940, 290, "Chunks of 8 rows with a latency of 3 rows: sequential and overlapped")
    unit = 34
    for top, name in ((40, "sequential"), (160, "overlap")):
        s.text(24, top + 22, name, bold=True, anchor="start")
        s.text(24, top + 62, "rows sent", small=True, anchor="start")
    for start in (0, 11):
        s.bar(130 + unit * start, 40, 3 * unit, 30, BLUE)
        s.text(130 + unit * (start + 1.5), 60, "predict", small=True)
        for row in range(8):
            s.bar(130 + unit * (start + 3 + row), 84, unit, 30, AMBER)
    for start in (0, 11):
        s.text(130 + unit * (start + 1.5), 104, "arm holds", small=True)
    for start in (0, 5, 10, 15):
        s.bar(130 + unit * start, 160, 3 * unit, 30, BLUE)
        s.text(130 + unit * (start + 1.5), 180, "predict", small=True)
    for row in range(19):
        s.bar(130 + unit * (3 + row), 204, unit, 30, GREEN if (row // 5) % 2 else AMBER)
    s.text(130 + unit * 1.5, 224, "arm holds", small=True)
    s.line((130, 258), (910, 258))
    s.text(890, 278, "time", small=True)
    s.text(500, 278, "a change of colour: the first row of a new answer", small=True)
    return s.svg()


def task() -> str:
    """Flow of run_task."""
    s = Sheet(940, 230, "run_task: attempts until the predicate holds, then an outcome")
    s.box(30, 80, 150, 64, "instruction", "to the policy", fill=AMBER)
    s.box(240, 80, 170, 64, "predicate", "evaluated every 50 ms", fill=BLUE)
    s.box(470, 80, 190, 64, "instruction back", "true with the arm at rest?", fill=BLUE)
    s.box(730, 20, 180, 44, "succeeded", fill=GREEN)
    s.box(730, 90, 180, 44, "unclear", "cannot be judged", fill=AMBER)
    s.box(730, 160, 180, 50, "failed, timed_out", "after the last attempt", fill=RED)
    s.line((180, 112), (240, 112))
    s.line((410, 112), (470, 112))
    s.text(440, 102, "true", small=True)
    s.line((660, 100), (695, 100), (695, 42), (730, 42))
    s.line((660, 112), (730, 112))
    s.line((325, 144), (325, 185), (730, 185))
    s.text(520, 178, "no time left, or the policy gave up", small=True)
    s.line((270, 144), (270, 205), (105, 205), (105, 146), dashed=True)
    s.text(188, 198, "next attempt", small=True)
    return s.svg()


def ring() -> str:
    """Recording of an incident from the ring."""
    s = Sheet(940, 170, "The ring becomes an incident when something fails")
    s.bar(60, 56, 540, 36, BLUE)
    s.text(330, 79, "ring: the last 30 s, always written")
    s.bar(600, 56, 110, 36, AMBER)
    s.text(655, 79, "5 s after")
    s.line((600, 118), (600, 36), head=False)
    s.text(600, 28, "fault or emergency stop", bold=True)
    s.line((60, 110), (710, 110))
    s.text(385, 132, "incidents/<id>.mcap: one file", small=True)
    s.bar(730, 56, 180, 36, WHITE)
    s.text(820, 79, "ring goes on")
    s.line((60, 148), (910, 148))
    s.text(890, 164, "time", small=True)
    return s.svg()


def fleet() -> str:
    """One server with several robots."""
    s = Sheet(940, 270, "One server operates several robots; each has its own processes and stop")
    s.box(30, 110, 120, 50, "agent", "one client", fill=WHITE)
    s.box(210, 30, 150, 210, "server", "one process,", "tools with", "robot=...", fill=BLUE)
    s.line((150, 135), (210, 135))
    for top, name, parts in (
        (30, "left", ("perception", "inference", "control", "robot")),
        (105, "right", ("perception", "inference", "control", "robot")),
        (180, "base", ("robot",)),
    ):
        s.line((360, top + 30), (420, top + 30))
        s.bar(420, top, 490, 60, WHITE)
        s.text(436, top + 34, name, bold=True, anchor="start")
        for number, part in enumerate(parts):
            s.box(500 + 82 * number, top + 12, 78, 36, fill=GREEN)
            s.text(539 + 82 * number, top + 34, part, small=True)
        s.text(866, top + 26, "own stop,", small=True)
        s.text(866, top + 42, "limits, audit", small=True)
    return s.svg()


def roles() -> str:
    """Clients over HTTP and their roles."""
    s = Sheet(940, 220, "Clients of one server over HTTP: roles, and one operator at a time")
    s.box(30, 20, 200, 50, "viewer", "reads; emergency stop", fill=GREEN)
    s.box(30, 85, 200, 50, "operator", "also starts and moves", fill=AMBER)
    s.box(30, 150, 200, 50, "admin", "also exposes and releases", fill=RED)
    s.box(400, 60, 200, 100, "server", "token, role,", "one operator at a time", fill=BLUE)
    for y in (45, 110, 175):
        s.line((230, y), (400, 110))
    s.box(720, 80, 190, 60, "robot", "one set of modules", fill=GREEN)
    s.line((600, 110), (720, 110))
    s.text(
        500,
        190,
        "silent for lease_s: policy stops, arm holds, any client may take over",
        small=True,
    )
    return s.svg()


FIGURES: dict[str, Callable[[], str]] = {
    "packages": packages,
    "stops": stops,
    "gate": gate,
    "switch": switch,
    "chunks": chunks,
    "task": task,
    "ring": ring,
    "fleet": fleet,
    "roles": roles,
    "plot-chunks": plot_chunks,
    "plot-fastv": plot_fastv,
    "plot-starts": plot_starts,
}


def main() -> int:
    """Write the figures, or compare them."""
    stale = []
    for name, draw in FIGURES.items():
        target, text = DOCS / "assets" / f"{name}.svg", draw()
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            stale.append(name)
            if "--check" not in sys.argv[1:]:
                target.write_text(text, encoding="utf-8")
    if "--check" in sys.argv[1:]:
        print(f"not current: {', '.join(stale)}" if stale else "current")
        return int(bool(stale))
    return 0


if __name__ == "__main__":
    sys.exit(main())
