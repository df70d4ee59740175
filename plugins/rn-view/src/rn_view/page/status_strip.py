"""The strip below the emergency stop: alarms, rates, past tasks and maintenance.

It is plain HTML (static/status_strip.*), so that keyboards and screen readers can use it and a
reload keeps it.
"""

from __future__ import annotations

from rn_view.static import read_static, script_element, style_element
from rn_view.web.page_requests import KEY_HEADER, PATH

_MAIN = '<main id="rn-main">'


def with_status_strip(page: str) -> str:
    """Add the strip and its panel to a page with its middle. They are hidden until the holder is
    known.
    """
    config = {"path": PATH, "header": KEY_HEADER}
    page = page.replace("</head>", f"{style_element('status_strip.css')}</head>", 1)
    # before viser's part, so that it comes right after the stop in the order of Tab
    strip, records = read_static("status_strip.html"), read_static("records.html")
    page = page.replace(_MAIN, f"{strip}{_MAIN}{records}", 1)
    return page.replace("</body>", f"{script_element('status_strip.js', config)}</body>", 1)
