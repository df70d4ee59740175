"""Latency of a prediction on the episode's clock: zero, measured, or drawn from a distribution."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from roboneuron import ConfigurationError

MEASURED = "measured"
Draw = Callable[[float], float]
"""Maps the measured duration of a prediction [s] to the simulated one [s]."""
_TIME = r"(\d+(?:\.\d+)?)(ms|s)?"
_FORMS = (
    "0, 112ms, 0.112s, normal:112ms,10ms, lognormal:112ms,0.2 (median, deviation of the "
    "logarithm), file:PATH, measured"
)


def parse_latency(text: str) -> Callable[[np.random.Generator], Draw]:
    """Return a function that creates an episode's `Draw` from its random generator.

    Args:
        text: one of the forms above; a number without a unit, as in old ledgers, is in seconds.
            `file:PATH` contains one latency [s] per line, drawn with replacement.

    Raises:
        ConfigurationError: it has none of these forms.
    """
    kind, _, rest = text.partition(":")
    if text == MEASURED:
        return lambda random: lambda measured_s: measured_s
    if kind == "file":
        return _from_file(Path(rest))
    if kind in ("normal", "lognormal"):
        centre, _, spread = rest.partition(",")
        middle_s = _seconds(centre, text)
        if kind == "normal":
            deviation_s = _seconds(spread, text)
            return lambda random: (
                lambda _: max(0.0, middle_s + deviation_s * random.standard_normal())
            )
        sigma = _seconds(spread, text)
        return lambda random: lambda _: middle_s * math.exp(sigma * random.standard_normal())
    constant_s = _seconds(text, text)
    return lambda random: lambda _: constant_s


def check_unit(text: str) -> None:
    """Refuse a time other than 0 without a unit: 112 may mean milliseconds or seconds.

    Raises:
        ConfigurationError: a unit is missing, or the form is invalid.
    """
    parse_latency(text)
    kind, _, rest = text.partition(":")
    middle, _, spread = rest.partition(",")
    times = {"normal": (middle, spread), "lognormal": (middle,), "file": (), MEASURED: ()}.get(
        kind, (text,)
    )
    for value in times:
        found = re.fullmatch(_TIME, value.strip())
        if found is not None and not found[2] and float(found[1]) != 0:
            number = found[1]
            raise ConfigurationError(
                f"--latency {text}: {number} has no unit.",
                hint=f"Say {number}ms or {number}s; without one only 0 is.",
            )
    if kind == "lognormal" and spread.strip().endswith("s"):
        raise ConfigurationError(
            f"--latency {text}: {spread} has a unit, but the deviation of a logarithm has none.",
            hint="Say lognormal:112ms,0.2 for a median of 112 ms that varies by about a fifth.",
        )


def _seconds(value: str, text: str) -> float:
    found = re.fullmatch(_TIME, value.strip())
    if found is None:
        raise ConfigurationError(
            f"The latency {text!r} is not understood; expected one of: {_FORMS}."
        )
    return float(found[1]) / (1000.0 if found[2] == "ms" else 1.0)


def _from_file(path: Path) -> Callable[[np.random.Generator], Draw]:
    try:
        values = np.loadtxt(path, ndmin=1)
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"The latencies in {path} cannot be read: {error}.") from error
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all() or (values < 0).any():
        raise ConfigurationError(
            f"{path} holds no latencies, expected one number of seconds >= 0 a line."
        )
    return lambda random: lambda _: float(random.choice(values))


def digest_of(text: str) -> str:
    """SHA-256 of the file of a latency, because its path says nothing of its content; "" for a
    latency without a file.

    Raises:
        ConfigurationError: it cannot be read.
    """
    kind, _, rest = text.partition(":")
    if kind != "file":
        return ""
    try:
        return hashlib.sha256(Path(rest).read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigurationError(f"The latencies in {rest} cannot be read: {error}.") from error


def median_s(text: str) -> float | None:
    """Median of a latency [s]; None if it is measured.

    Raises:
        ConfigurationError: as `parse_latency`.
    """
    kind, _, rest = text.partition(":")
    if text == MEASURED:
        return None
    if kind == "file":
        return float(np.median(np.loadtxt(rest, ndmin=1)))
    return _seconds(rest.partition(",")[0] if rest else text, text)
