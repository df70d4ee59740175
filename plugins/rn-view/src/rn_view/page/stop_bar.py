"""The bar above the page with the emergency stop: plain HTML and requests, so that it needs no seat
and no WebGL.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

from rn_view.static import script_element, style_element
from roboneuron import PluginError

STOP_PATH = "/emergency_stop"
"""GET with the header below latches the emergency stop; `?robot=NAME` that of one robot."""
STATE_PATH = "/emergency_stop/state"
HEADER = "X-RoboNeuron"
"""Pages of other origins cannot send it without being allowed to, and no link or image can."""
HEADER_VALUE = "stop"
KEY = "F9"
TITLE = "RoboNeuron"
_HEAD, _BODY = "<title>Viser</title>", '<div id="root"></div>'
"""What is replaced in viser's page."""

DARK_COOKIE, WIDTH_COOKIE = "roboneuron_dark", "roboneuron_width"
_DISPLAY_COOKIES = f"""document.cookie = "{DARK_COOKIE}=" +
  Number(matchMedia("(prefers-color-scheme: dark)").matches) + "; path=/; SameSite=Strict";
document.cookie = "{WIDTH_COOKIE}=" + Math.round(innerWidth) + "; path=/; SameSite=Strict";"""
"""Before viser's program connects: it is the server that says whether its part is dark, and where
the panels are. The width of the scene is another, once a panel is beside it.
"""


def base_page() -> str:
    """viser's page.

    Raises:
        PluginError: this version of viser has another page than this package expects.
    """
    import viser  # heavy

    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text(
        encoding="utf-8"
    )
    if page.count(_HEAD) != 1 or page.count(_BODY) != 1:
        raise PluginError(
            f"The page of viser {viser.__version__} is another than expected.",
            hint="Use viser 1.1.",
        )
    return page


def page_with_bar(base: str, robots: Sequence[str]) -> str:
    """The page of these robots, with the emergency stop.

    Args:
        base: result of `base_page`.
        robots: their names; with several, each has its own stop beside the common one.
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
        "title": title,
        "ready": f"Not pressed. {', '.join(robots)}".rstrip(". "),
    }
    style, script = style_element("stop_bar.css"), script_element("stop_bar.js", config)
    head = f"<title>{escape(title)}</title>{style}<script>{_DISPLAY_COOKIES}</script>"
    return base.replace(_HEAD, head).replace(_BODY, f"{bar}{_BODY}{script}")


def page_without_stop(base: str, title: str) -> str:
    """The page of a recording: without the emergency stop, as there is no robot."""
    return base.replace(_HEAD, f"<title>{escape(title)} - {TITLE}</title>")
