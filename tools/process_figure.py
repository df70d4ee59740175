"""Draw docs/assets/processes.svg, the figure of processes and topics, from the tables in this
module.

    python tools/process_figure.py           write it
    python tools/process_figure.py --check   exit status 1 unless the committed file is current

The panel has its own background, so that it is readable on light and dark pages.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

TARGET = Path(__file__).parents[1] / "docs" / "assets" / "processes.svg"
WIDTH_PX, HEIGHT_PX = 960, 470
INK, FAINT, PANEL = "#1f2a37", "#5b6776", "#f7f9fb"


@dataclass(frozen=True, kw_only=True, slots=True)
class Box:
    """A process: corner and size [px], fill colour, title and lines of text."""

    x: int
    y: int
    width: int
    height: int
    fill: str
    title: str
    lines: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class Arrow:
    """A stream: corner points [px], label, and the centre of the label [px]."""

    points: tuple[tuple[int, int], ...]
    label: str = ""
    at: tuple[int, int] = (0, 0)
    dashed: bool = False
    both: bool = False


BOXES = (
    Box(x=30, y=30, width=160, height=80, fill="#ffffff", title="agent", lines=("any MCP client",)),
    Box(
        x=290,
        y=24,
        width=640,
        height=92,
        fill="#dbeafe",
        title="server",
        lines=(
            "roboneuron serve: typed tools, gate, supervisor, plugins",
            "limits, emergency stop, roles, audit",
        ),
    ),
    *(
        Box(x=x, y=246, width=width, height=80, fill=fill, title=title, lines=(line,))
        for x, width, fill, title, line in (
            (30, 160, "#dcfce7", "perception", "camera or simulation"),
            (270, 170, "#fef3c7", "inference", "model or visual servo"),
            (520, 160, "#fef3c7", "control", "kinematics, limits"),
            (770, 160, "#dcfce7", "robot", "driver of the arm"),
        )
    ),
)
ARROWS = (
    Arrow(points=((190, 70), (290, 70)), label="MCP", at=(240, 58), both=True),
    Arrow(points=((240, 70), (240, 70)), label="stdio, HTTP", at=(240, 90)),
    Arrow(points=((310, 116), (310, 170), (110, 170), (110, 246)), dashed=True),
    Arrow(points=((355, 116), (355, 246)), dashed=True),
    Arrow(points=((600, 116), (600, 246)), dashed=True),
    Arrow(points=((815, 116), (815, 246)), dashed=True),
    Arrow(points=((900, 116), (900, 246)), label="direct tools", at=(857, 150)),
    Arrow(points=((190, 286), (270, 286)), label="image", at=(230, 276)),
    Arrow(points=((440, 286), (520, 286)), label="action", at=(480, 276)),
    Arrow(points=((680, 286), (770, 286)), label="command", at=(725, 276)),
    Arrow(points=((850, 326), (850, 378), (355, 378), (355, 326))),
    Arrow(points=((600, 378), (600, 326)), label="joint_states, ee_pose", at=(727, 396)),
)


def box(b: Box) -> str:
    """Draw one process."""
    middle = b.x + b.width // 2
    texts = [f'<text x="{middle}" y="{b.y + 30}" class="t">{escape(b.title)}</text>']
    texts += [
        f'<text x="{middle}" y="{b.y + 53 + 20 * i}">{escape(line)}</text>'
        for i, line in enumerate(b.lines)
    ]
    shape = (
        f'<rect x="{b.x}" y="{b.y}" width="{b.width}" height="{b.height}" rx="8" '
        f'fill="{b.fill}" stroke="{INK}"/>'
    )
    return "\n".join((shape, *texts))


def arrow(a: Arrow) -> str:
    """Draw one stream."""
    path = " ".join(f"{x},{y}" for x, y in a.points)
    style = ' stroke-dasharray="5 4"' if a.dashed else ""
    start = ' marker-start="url(#head)"' if a.both else ""
    drawn = (
        f'<polyline points="{path}" fill="none" stroke="{INK}"{style}{start} '
        'marker-end="url(#head)"/>'
    )
    moves = len(set(a.points)) > 1
    label = (
        f'<text x="{a.at[0]}" y="{a.at[1]}" class="l">{escape(a.label)}</text>' if a.label else ""
    )
    return "\n".join(part for part in (drawn if moves else "", label) if part)


def figure() -> str:
    """Return the whole file."""
    head = f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH_PX} {HEIGHT_PX}" role="img" \
font-family="system-ui, sans-serif" font-size="14" text-anchor="middle" fill="{INK}">
<title>Processes and topics of RoboNeuron</title>
<desc>An agent speaks MCP to the server. The server supervises four processes: perception publishes images to \
inference, inference publishes actions to control, control publishes commands to the robot, and the robot publishes \
joint_states and ee_pose to control and inference. Tools of the direct path reach the robot through the gate.</desc>
<style>.t {{ font-weight: 600; font-size: 17px }} .l {{ font-size: 12.5px; fill: {FAINT} }}</style>
<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" markerHeight="8" \
orient="auto-start-reverse"><path d="M0,1 L10,5 L0,9 z" fill="{INK}"/></marker></defs>
<rect width="{WIDTH_PX}" height="{HEIGHT_PX}" rx="12" fill="{PANEL}"/>"""  # noqa: E501
    notes = f"""<text x="30" y="140" text-anchor="start" class="l">control plane: one process</text>
<text x="126" y="220" text-anchor="start" class="l">data plane: ROS 2 topics</text>
<text x="478" y="176" class="l">dashed: start, stop, watch</text>
<text x="478" y="194" class="l">(lifecycle services, /diagnostics)</text>
<text x="{WIDTH_PX // 2}" y="440" class="l">Each box is an operating-system process. Solid lines carry data. \
The emergency stop reaches control and robot by a topic and by a file.</text>"""  # noqa: E501
    return "\n".join((head, *map(arrow, ARROWS), *map(box, BOXES), notes, "</svg>", ""))


def main() -> int:
    """Write the figure, or compare it."""
    if "--check" in sys.argv[1:]:
        return int(not TARGET.exists() or TARGET.read_text(encoding="utf-8") != figure())
    TARGET.write_text(figure(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
