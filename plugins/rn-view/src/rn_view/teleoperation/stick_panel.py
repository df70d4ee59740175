"""The panel in which a person leads the arm with sticks, keys or a gamepad, and labels recordings.

It is plain HTML (static/stick_panel.*, static/label_form.*) beside viser's, so that its 50 samples
a second do not pass through viser's messages or its scene.
"""

from __future__ import annotations

import json
from html import escape

from rn_view.static import read_static, script_element, style_element

SOCKET_PATH = "/lead/socket"
"""Path of the websocket; `?key=` of a page that may lead."""
PROTOCOL = "viser-v1"
"""Subprotocol of that websocket; viser's server accepts no other name."""
RATE_HZ = 50
FULL_M_S, FULL_RAD_S, FULL_SHARE = 0.25, 0.8, 0.25
"""Speed at full deflection of a stick [m/s, rad/s], and of a joint as a share of its limit."""
LEAD_KEY_ID = "rn-lead-key"


def key_html(key: str, joints: dict[str, float], *, labels: bool) -> str:
    """HTML element that permits the page to lead and to label recordings.

    Args:
        key: key of its websocket.
        joints: speed of each joint while its button is held [rad/s or m/s]; empty if the robot
            cannot be led.
        labels: whether the page may label recordings.
    """
    told = escape(json.dumps(joints), quote=True)
    return (
        f'<div id="{LEAD_KEY_ID}" data-key="{escape(key, quote=True)}" data-joints="{told}" '
        f'data-labels="{int(labels)}"></div>'
    )


def with_stick_panel(page: str) -> str:
    """Add both panels to a page. They are hidden until the page may lead or label."""
    config = {
        "path": SOCKET_PATH,
        "protocol": PROTOCOL,
        "rate": RATE_HZ,
        "full": [FULL_M_S, FULL_RAD_S],
    }
    style = style_element("stick_panel.css", "label_form.css")
    page = page.replace("</head>", f"{style}</head>", 1)
    form = read_static("label_form.html")
    body = read_static("stick_panel.html").replace("<!-- label_form.html -->", form)
    scripts = f"{script_element('stick_panel.js', config)}{script_element('label_form.js')}"
    return page.replace("</body>", f"{body}{scripts}</body>", 1)
