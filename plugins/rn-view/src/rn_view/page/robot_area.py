"""The middle of the page: cameras, and viser's scene and panels below what says that it waits.

It is plain HTML (static/robot_area.*). The page reloads itself when viser's part stays empty.
"""

from __future__ import annotations

from html import escape

from rn_view.page.stop_bar import ROOT, STATE_PATH
from rn_view.static import read_static, script_element, style_element
from rn_view.teleoperation.stick_panel import LEAD_KEY_ID, PROTOCOL
from rn_view.web.page_requests import PICTURES_PATH, UNKNOWN_KEY

_KEY_ID = "rn-page-key"
SHOWN = "data-rn-shown"
"""Attribute of an element that viser shows once the page is built."""
RELOAD_S = 60.0
"""Time after which a page without content is reloaded; twice as long after each try. A browser that
draws on a busy processor needs up to 40 s.
"""
_OLD_S = 1.0
"""Age from which a camera's picture is marked as old."""


def key_html(key: str) -> str:
    """HTML element that holds the key for the requests of the page."""
    return f'<div id="{_KEY_ID}" {SHOWN} data-key="{escape(key, quote=True)}"></div>'


def with_robot_area(page: str, *, is_live: bool) -> str:
    """Add the middle to a page; in a recording, pictures have no age."""
    config = {
        "id": _KEY_ID,
        "lead": LEAD_KEY_ID,
        "unknown": UNKNOWN_KEY,
        "pictures": PICTURES_PATH,
        "protocol": PROTOCOL,
        "state": STATE_PATH,
        "reload_s": RELOAD_S,
        "old_s": _OLD_S,
        "live": is_live,
    }
    page = page.replace("</head>", f"{style_element('robot_area.css')}</head>", 1)
    page = page.replace(ROOT, read_static("robot_area.html"), 1)
    return page.replace("</body>", f"{script_element('robot_area.js', config)}</body>", 1)
