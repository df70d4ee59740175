"""Browsers with an open page, by cookie, so that the audit names who pressed the stop."""

from __future__ import annotations

import re
import secrets
import threading
from collections.abc import Mapping
from typing import Protocol

from rn_view.page.stop_bar import DARK_COOKIE, WIDTH_COOKIE

_COOKIE = "roboneuron_view"
_PATTERN = re.compile(rf"(?:^|;\s*){_COOKIE}=([\w-]{{10,80}})(?:;|$)")

_WIDTH = re.compile(rf"(?:^|;\s*){WIDTH_COOKIE}=(\d{{1,5}})(?:;|$)")
_DARK = re.compile(rf"(?:^|;\s*){DARK_COOKIE}=1(?:;|$)")


class _PageRequest(Protocol):
    @property
    def headers(self) -> Mapping[str, str]: ...


class Visitors:
    """Names of the holders with an open page, by the cookie of their browser; usable from any
    thread.

    The cookie grants nothing: everybody may press the stop, with or without it.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._cookies: dict[int, str] = {}
        self._names: dict[int, str] = {}
        self._dark: set[int] = set()
        self._widths: dict[int, int] = {}

    def cookie(self, request: _PageRequest) -> str:
        """Set-Cookie header for a browser; keeps its present cookie."""
        value = _cookie_of(request) or secrets.token_urlsafe(16)
        return f"{_COOKIE}={value}; Path=/; HttpOnly; SameSite=Strict"

    def connect(self, number: int, request: _PageRequest) -> None:
        """Register a page whose websocket was opened."""
        with self._lock:
            self._cookies[number] = _cookie_of(request)
            width = _WIDTH.search(request.headers.get("Cookie", ""))
            self._widths[number] = int(width.group(1)) if width else 0
            if _DARK.search(request.headers.get("Cookie", "")):
                self._dark.add(number)

    def wants_dark(self, number: int) -> bool:
        """Whether that page's browser prefers dark colours."""
        with self._lock:
            return number in self._dark

    def width_px(self, number: int) -> int:
        """Width of that page when it was loaded [px]; 0 if unknown."""
        with self._lock:
            return self._widths.get(number, 0)

    def name(self, number: int, who: str) -> None:
        """Register the holder of that page."""
        with self._lock:
            self._names[number] = who

    def disconnect(self, number: int) -> None:
        """Remove a page that was closed."""
        with self._lock:
            self._cookies.pop(number, None)
            self._names.pop(number, None)
            self._dark.discard(number)
            self._widths.pop(number, None)

    def who(self, request: _PageRequest, address: str) -> str:
        """Name of the sender of a request: the holder of the newest page of that browser."""
        cookie = _cookie_of(request)
        with self._lock:
            pages = [
                number for number, other in self._cookies.items() if cookie and other == cookie
            ]
            named = [self._names[number] for number in pages if number in self._names]
        return named[-1] if named else f"a view without a token ({address})"


def _cookie_of(request: _PageRequest) -> str:
    found = _PATTERN.search(request.headers.get("Cookie", ""))
    return found.group(1) if found else ""
