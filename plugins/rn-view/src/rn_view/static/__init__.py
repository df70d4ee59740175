"""Styles (.css), HTML and scripts (.js) of the parts of the page that viser does not provide."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources


@cache
def read_static(name: str) -> str:
    """Text of a file in this folder, by its name such as "stop_bar.css"."""
    return resources.files(__name__).joinpath(name).read_text(encoding="utf-8")


def style_element(*names: str) -> str:
    """HTML style element with these files."""
    return f"<style>{''.join(read_static(name) for name in names)}</style>"


def script_element(name: str, config: object = None) -> str:
    """HTML script element that runs this file.

    Args:
        name: the file. Its program is one block, so it shares no names with the others.
        config: JSON-compatible; the program reads it as `CONFIG`.
    """
    text = json.dumps(config).replace("<", "\\u003c")  # "</script>" would end the element
    return f"<script>{{ const CONFIG = {text};\n{read_static(name)}}}</script>"
