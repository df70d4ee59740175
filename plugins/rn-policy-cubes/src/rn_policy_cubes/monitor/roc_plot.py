"""The ROC curves as an SVG, without a plotting library."""

from __future__ import annotations

from collections.abc import Sequence

from rn_policy_cubes.monitor.assessment import JudgedEpisode
from rn_policy_cubes.monitor.statistics import area, roc

_LEFT, _TOP, _SIDE = 60, 20, 300
_COLOURS = ("#1f6feb", "#bc4c00")


def roc_svg(judged: Sequence[JudgedEpisode]) -> str:
    """The curves of success (against failing episodes) and of failure (against successes)."""
    good = [each for each in judged if each.is_success]
    bad = [each for each in judged if not each.is_success]
    pairs = (
        ("success", [each.success for each in good], [each.success for each in bad]),
        ("failure", [each.failure for each in bad], [each.failure for each in good]),
    )
    parts = [_frame()]
    for index, (name, positive, negative) in enumerate(pairs):
        false, true = roc(positive, negative)
        points = _steps(false.tolist(), true.tolist())
        line = f'fill="none" stroke="{_COLOURS[index]}" stroke-width="2"'
        parts.append(f'<polyline points="{points}" {line}/>')
        told = f"{name}: area {area(positive, negative):.4f}"
        place = f'x="{_LEFT + 110}" y="{_TOP + 240 + 22 * index}"'
        parts.append(f'<text {place} fill="{_COLOURS[index]}">{told}</text>')
    size = f'viewBox="0 0 {_LEFT + _SIDE + 20} {_TOP + _SIDE + 50}"'
    style = 'font-family="sans-serif" font-size="14"'
    body = "\n".join(parts)
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} {style}>\n{body}\n</svg>\n'


def _frame() -> str:
    bottom, right = _TOP + _SIDE, _LEFT + _SIDE
    parts = [
        '<rect width="100%" height="100%" fill="white"/>',
        f'<rect x="{_LEFT}" y="{_TOP}" width="{_SIDE}" height="{_SIDE}" fill="none" '
        'stroke="#888"/>',
        f'<line x1="{_LEFT}" y1="{bottom}" x2="{right}" y2="{_TOP}" stroke="#bbb" '
        'stroke-dasharray="4"/>',
        f'<text x="{_LEFT + _SIDE / 2}" y="{bottom + 38}" text-anchor="middle">'
        "rate of false alarms</text>",
        f'<text transform="translate(18 {_TOP + _SIDE / 2}) rotate(-90)" text-anchor="middle">'
        "rate of true alarms</text>",
    ]
    for share in (0.0, 0.5, 1.0):
        x, y = _LEFT + share * _SIDE, bottom - share * _SIDE
        parts.append(f'<text x="{x}" y="{bottom + 18}" text-anchor="middle">{share:g}</text>')
        parts.append(f'<text x="{_LEFT - 8}" y="{y + 5}" text-anchor="end">{share:g}</text>')
    return "\n".join(parts)


def _steps(false: Sequence[float], true: Sequence[float]) -> str:
    pairs = zip(false, true, strict=True)
    return " ".join(f"{_LEFT + f * _SIDE:.1f},{_TOP + (1 - t) * _SIDE:.1f}" for f, t in pairs)
