"""Digest to compare two episodes: calls, last words, and final positions."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable

from rn_eval.agents.conduct import Conduct
from rn_eval.agents.truth import Truth

_DIGITS = 6
"""A millionth of a metre or radian: smaller differences are floating-point noise."""


def episode_digest(truth: Truth, conduct: Conduct) -> str:
    """16 hexadecimal digits, equal for equal episodes: calls with arguments and errors, last words,
    and the end of every robot and cube to 1e-6 m and rad. Times are not included.
    """
    arms = [
        [] if arm.is_empty else [*_rounded(arm.joints_rad[-1]), *_rounded(arm.cubes_m[-1].ravel())]
        for _, arm in sorted({"": truth, **truth.others}.items())
    ]
    bases = [_rounded(base.end) for _, base in sorted(truth.bases.items())]
    calls = [(call.tool, call.arguments, call.code) for call in conduct.calls]
    text = json.dumps([calls, conduct.words, arms, bases], separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _rounded(values: Iterable[float]) -> list[float]:
    # because -0.0 and 0.0 are the same position
    return [round(float(value), _DIGITS) + 0.0 for value in values]
