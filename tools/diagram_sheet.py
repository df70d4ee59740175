"""An SVG drawing: boxes, lines and text in the colours of the documentation."""

from __future__ import annotations

from xml.sax.saxutils import escape

INK, FAINT, PANEL = "#1f2a37", "#5b6776", "#f7f9fb"
BLUE, GREEN, AMBER, RED, WHITE = "#dbeafe", "#dcfce7", "#fef3c7", "#fee2e2", "#ffffff"


class Sheet:
    """A drawing [px], composed of boxes, lines and text."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self._head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
            f'font-family="DejaVu Sans, system-ui, sans-serif" font-size="14" text-anchor="middle" '
            f'fill="{INK}">\n<title>{escape(title)}</title>\n'
            '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="8" '
            'markerHeight="8" orient="auto-start-reverse"><path d="M0,1 L10,5 L0,9 z" '
            f'fill="{INK}"/></marker></defs>\n'
            f'<rect width="{width}" height="{height}" rx="12" fill="{PANEL}"/>'
        )
        self._parts: list[str] = []

    def box(self, x: int, y: int, w: int, h: int, *lines: str, fill: str = WHITE) -> None:
        """Draw a rectangle; its first line is a title."""
        self._parts.append(
            f'<rect x="{x}" y="{y}" width="{w}" height="{h}" rx="8" fill="{fill}" stroke="{INK}"/>'
        )
        top = y + h / 2 - 9 * (len(lines) - 1) + 5
        for number, line in enumerate(lines):
            self.text(x + w / 2, top + 18 * number, line, bold=number == 0, small=number > 0)

    def text(
        self,
        x: float,
        y: float,
        text: str,
        *,
        bold: bool = False,
        small: bool = False,
        anchor: str = "middle",
    ) -> None:
        """Draw one line of text."""
        style = (
            ' font-weight="600"' if bold else f' font-size="12.5" fill="{FAINT}"' if small else ""
        )
        self._parts.append(
            f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}"{style}>{escape(text)}</text>'
        )

    def line(self, *points: tuple[float, float], head: bool = True, dashed: bool = False) -> None:
        """Draw a line through points, with an arrow head at its end."""
        path = " ".join(f"{x:g},{y:g}" for x, y in points)
        self._parts.append(
            f'<polyline points="{path}" fill="none" stroke="{INK}"'
            f"{' stroke-dasharray=' + chr(34) + '5 4' + chr(34) if dashed else ''}"
            f"{' marker-end=' + chr(34) + 'url(#head)' + chr(34) if head else ''}/>"
        )

    def bar(self, x: float, y: float, w: float, h: float, fill: str) -> None:
        """Draw a plain rectangle."""
        self._parts.append(
            f'<rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" fill="{fill}" stroke="{INK}" '
            'stroke-width="0.7"/>'
        )

    def svg(self) -> str:
        """Return the whole file."""
        return "\n".join([self._head, *self._parts, "</svg>", ""])
