"""Check that a built site needs no network: no script, style, font, image or frame from another
host.

    python tools/check_site.py out/site

Ordinary links (`<a href>`) may lead anywhere. `mermaid` blocks are refused because the theme would
load their script from another host. Exit status 1 names each file with what it loads.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

_LOADS = {"src", "srcset", "data", "poster", "action"}
_LOADING_LINKS = {
    "stylesheet",
    "icon",
    "preload",
    "preconnect",
    "dns-prefetch",
    "modulepreload",
    "manifest",
    "prefetch",
}
_EXTERNAL = re.compile(r"^(?:https?:)?//", re.IGNORECASE)
_IN_CSS = re.compile(r"""(?:url\(\s*|@import\s+)["']?((?:https?:)?//[^"')\s]+)""", re.IGNORECASE)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.in_style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.in_style = tag == "style"
        loads = _LOADS | ({"href"} if tag == "link" and self._link_loads(values) else set())
        self.found += [
            f"<{tag} {n}={v}>" for n, v in values.items() if n in loads and _EXTERNAL.match(v)
        ]
        self.found += [f"<{tag} style={url}>" for url in _IN_CSS.findall(values.get("style", ""))]
        if "mermaid" in values.get("class", "").split():
            self.found.append(f"<{tag} class=mermaid>")

    @staticmethod
    def _link_loads(values: dict[str, str]) -> bool:
        return bool(set(values.get("rel", "").lower().split()) & _LOADING_LINKS)

    def handle_endtag(self, tag: str) -> None:
        self.in_style = self.in_style and tag != "style"

    def handle_data(self, data: str) -> None:
        if self.in_style:
            self.found += _IN_CSS.findall(data)


def external_resources(site: Path) -> list[str]:
    """One line per resource that a page or style sheet would load from another host, with its
    file.
    """
    found = []
    for path in sorted(site.rglob("*.html")):
        page = _Page()
        page.feed(path.read_text(encoding="utf-8"))
        found += [f"{path.relative_to(site)}: {what}" for what in page.found]
    for path in sorted(site.rglob("*.css")):
        found += [
            f"{path.relative_to(site)}: {url}"
            for url in _IN_CSS.findall(path.read_text(encoding="utf-8"))
        ]
    return found


def main(arguments: list[str]) -> int:
    """Check the site in the given folder."""
    site = Path(arguments[0])
    pages = len(list(site.rglob("*.html")))
    if not pages:
        print(f"{site} holds no page.")
        return 1
    found = external_resources(site)
    print("\n".join(found) if found else f"{pages} pages load nothing from another host.")
    return int(bool(found))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
