"""The bar with the emergency stop above the page.

It is plain HTML with HTTP requests (static/stop_bar.*), so it needs no websocket and no WebGL.
"""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from rn_view.static import script_element, style_element
from roboneuron import PluginError

STOP_PATH = "/emergency_stop"
"""GET with `HEADER` latches the emergency stop; `?robot=NAME`: of one robot."""
STATE_PATH = "/emergency_stop/state"
HEADER = "X-RoboNeuron"
"""Pages of other origins need a permission to send it, and links and images cannot send it."""
HEADER_VALUE = "stop"
KEY = "F9"
TITLE = "RoboNeuron"
_HEAD, ROOT = "<title>Viser</title>", '<div id="root"></div>'
"""Parts of viser's page that are replaced."""

DARK_COOKIE, WIDTH_COOKIE = "roboneuron_dark", "roboneuron_width"
_DISPLAY_COOKIES = f"""document.cookie = "{DARK_COOKIE}=" +
  Number(matchMedia("(prefers-color-scheme: dark)").matches) + "; path=/; SameSite=Strict";
document.cookie = "{WIDTH_COOKIE}=" + Math.round(innerWidth) + "; path=/; SameSite=Strict";"""
"""Set before viser's program connects, because the server chooses the theme and the place of the
panels. The width must be that of the whole page; viser reports only that of the scene.
"""


def stop_holder(first: bytes) -> str:
    """Not empty if the first bytes of a connection ask for the emergency stop, which everybody may
    press and which therefore is served before other requests.
    """
    path = first.removeprefix(b"GET ").split(b" ", 1)[0].split(b"?", 1)[0]
    return "stop" if first.startswith(b"GET ") and path == STOP_PATH.encode() else ""


def base_page() -> str:
    """Read viser's page.

    Raises:
        PluginError: the page of this version of viser differs from the expected one.
    """
    import viser  # heavy

    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(
        encoding="utf-8"
    )
    if page.count(_HEAD) != 1 or page.count(ROOT) != 1:
        raise PluginError(
            f"The page of viser {viser.__version__} differs from the expected one.",
            hint="Install viser 1.1.",
        )
    return page


def page_with_bar(base: str, robots: Sequence[str], release: Mapping[str, str]) -> str:
    """Add the bar with the emergency stop of these robots to a page.

    Args:
        base: result of `base_page`.
        robots: names; several robots get a stop each, beside the common one.
        release: command that releases the stop, by the name of a robot in the answer of
            `STATE_PATH`.
    """
    title = f"{', '.join(robots)} - {TITLE}" if any(robots) else TITLE
    several = len(robots) > 1
    ones = "".join(
        f'<button type="button" class="rn-one" data-robot="{escape(name)}">Stop '
        f"{escape(name)}</button>"
        for name in robots
        if several
    )
    what = "EMERGENCY STOP, ALL" if several else "EMERGENCY STOP"
    bar = (
        '<div id="rn-bar" role="region" aria-label="Emergency stop">'
        f'<button id="rn-stop" type="button" data-robot="" aria-keyshortcuts="{KEY}" title="Key '
        f"{KEY}, anywhere on "
        f'this page">{what}<kbd>{KEY}</kbd></button>{ones}<div id="rn-state" '
        'role="status" aria-live="assertive"></div></div>'
    )
    config = {
        "robots": list(robots),
        "stop": STOP_PATH,
        "state": STATE_PATH,
        "header": HEADER,
        "value": HEADER_VALUE,
        "key": KEY,
        "release": dict(release),
        "machine": socket.gethostname(),
        "title": title,
        "ready": f"Not pressed. {', '.join(robots)}".rstrip(". "),
    }
    style, script = style_element("stop_bar.css"), script_element("stop_bar.js", config)
    head = f"<title>{escape(title)}</title>{style}<script>{_DISPLAY_COOKIES}</script>"
    return base.replace(_HEAD, head).replace(ROOT, f"{bar}{ROOT}{script}")


def page_without_stop(base: str, title: str) -> str:
    """The page of a recording, which has no emergency stop because there is no robot."""
    return base.replace(_HEAD, f"<title>{escape(title)} - {TITLE}</title>")
