"""Supported releases of SGLang; its internal interfaces change between releases."""

from __future__ import annotations

TESTED = ("0.5.23",)
"""Releases whose answers were compared with the in-process runtime."""
SUPPORTED = (0, 5, 23), (0, 5, 24)
"""First supported release, and first unsupported one."""


def is_supported(version: str) -> bool:
    """True if a release such as "0.5.23" or "0.5.23.post1" is within SUPPORTED."""
    numbers: list[int] = []
    for part in version.split(".")[:3]:
        digits = part[: len(part) - len(part.lstrip("0123456789"))]
        if not digits:
            return False
        numbers.append(int(digits))
    first, end = SUPPORTED
    return first <= tuple(numbers) < end
