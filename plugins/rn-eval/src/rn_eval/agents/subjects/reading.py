"""Parser for scripted agents: colours, distances, directions and numbers in a person's sentence."""

from __future__ import annotations

import re

COLOURS = ("red", "green", "blue", "yellow", "orange", "purple")
_SIDES = {
    "left": ("dy_m", 1.0),
    "right": ("dy_m", -1.0),
    "up": ("dz_m", 1.0),
    "upwards": ("dz_m", 1.0),
    "down": ("dz_m", -1.0),
    "forwards": ("dx_m", 1.0),
    "back": ("dx_m", -1.0),
}
_MOVE = re.compile(
    r"(?P<distance>\d+(?:\.\d+)?)\s*(?P<unit>cm|centimetres|m|metres)\s+(?:further\s+)?"
    r"(?:straight\s+)?(?:to the\s+)?(?P<side>left|right|upwards|up|down|forwards|back)\b"
)
_LOWER = re.compile(r"lower the hand by (?P<distance>\d+) cm")
_PLACE = re.compile(r"\((-?\d+\.?\d*), (-?\d+\.?\d*)(?:, (-?\d+\.?\d*))?\)")
_AXES = re.compile(r"\b([xyz]) = (-?\d+\.?\d*)")


def spoken(instruction: str) -> str:
    """The person's sentence in lower case, without the required form of the last words."""
    return instruction.partition("\n\n")[0].lower()


def named_colours(text: str) -> list[str]:
    """Colours in order of first mention, without duplicates."""
    return list(dict.fromkeys(re.findall(rf"\b({'|'.join(COLOURS)})\b", text)))


def moves_of(text: str) -> tuple[dict[str, float], ...]:
    """Moves by a distance, as arguments of move_ee."""
    found: list[dict[str, float]] = []
    for match in _MOVE.finditer(text):
        axis, sign = _SIDES[match["side"]]
        metres = float(match["distance"]) / (100.0 if match["unit"].startswith("c") else 1.0)
        found.append({axis: sign * metres})
    for match in _LOWER.finditer(text):
        found.append({"dz_m": -float(match["distance"]) / 100})
    return tuple(found)


def place_of(text: str) -> dict[str, float]:
    """The last named position, by axis; unnamed axes are left out."""
    places, axes = list(_PLACE.finditer(text)), list(_AXES.finditer(text))
    if places and not (axes and axes[-1].start() > places[-1].start()):
        return {a: float(v) for a, v in zip("xyz", places[-1].groups(), strict=True) if v}
    return {found[1]: float(found[2]) for found in axes}


def number_before(text: str, unit: str) -> float | None:
    """The first number right before a unit; None if there is none."""
    found = re.search(rf"(-?\d+(?:\.\d+)?)\s*{unit}", text)
    return float(found[1]) if found else None
