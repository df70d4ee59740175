"""Short summaries of data too large for an agent: long arrays, laser scans, point clouds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from roboneuron.tools.ros.interfaces.bounds import DecodeLimits
from roboneuron.tools.ros.interfaces.description import Plain

if TYPE_CHECKING:
    from sensor_msgs.msg import Image, LaserScan, PointCloud2

_SECTORS = 8
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""numpy kinds by PointField.datatype. Source: sensor_msgs/msg/PointField constants."""

Summarizer = Callable[[object, DecodeLimits], Plain]


def to_number(value: float, digits: int = 6) -> Plain:
    """Convert a float to JSON: rounded to significant digits, non-finite values as text."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return float(f"{value:.{digits}g}")


def summarize_numbers(values: NDArray[np.number], first: Sequence[Plain]) -> Plain:
    """Length, smallest, largest, mean and the first elements; statistics are over the finite
    values.
    """
    summary: dict[str, Plain] = {"length": int(values.size)}
    finite = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if finite.size:
        exact = values.dtype.kind != "f"
        low, high = finite.min().item(), finite.max().item()
        summary["min"], summary["max"] = (low, high) if exact else (to_number(low), to_number(high))
        summary["mean"] = to_number(_mean(finite))
    if finite.size != values.size:
        summary["nonfinite"] = int(values.size - finite.size)
    summary["first"] = list(first)
    return summary


def _mean(values: NDArray[np.number]) -> float:
    """The mean in float64, also if the sum would overflow."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(np.mean(values, dtype=np.float64))
    return mean if math.isfinite(mean) else float(np.sum(values.astype(np.float64) / values.size))


def summarize_scan(scan: LaserScan, limits: DecodeLimits) -> Plain:
    """LaserScan.ranges: number of valid beams, direction of the nearest obstacle, nearest range per
    sector.

    Angles in rad, counter-clockwise from the scanner's x axis; ranges in m. A beam is valid if it
    is finite and within range_min .. range_max (Source: sensor_msgs/msg/LaserScan).
    """
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    valid = np.isfinite(ranges) & (ranges >= scan.range_min) & (ranges <= scan.range_max)
    summary: dict[str, Plain] = {"beams": int(ranges.size), "valid": int(valid.sum())}
    if not valid.any():
        return summary
    angles = scan.angle_min + scan.angle_increment * np.arange(ranges.size)
    masked = np.where(valid, ranges, np.inf)
    nearest = int(np.argmin(masked))
    summary["nearest"] = _beam(masked[nearest], angles[nearest])
    summary["mean_m"] = to_number(float(ranges[valid].mean()), 4)
    sectors: list[Plain] = []
    for part, heading in zip(
        np.array_split(masked, _SECTORS), np.array_split(angles, _SECTORS), strict=True
    ):
        if part.size:
            low, high = to_number(float(heading[0]), 4), to_number(float(heading[-1]), 4)
            found: Plain = to_number(float(part.min()), 4) if np.isfinite(part.min()) else None
            sectors.append({"from_rad": low, "to_rad": high, "nearest_m": found})
    summary["sectors"] = sectors
    return summary


def _beam(range_m: np.floating, angle_rad: np.floating) -> Plain:
    return {"range_m": to_number(float(range_m), 4), "angle_rad": to_number(float(angle_rad), 4)}


def summarize_cloud(cloud: PointCloud2, limits: DecodeLimits) -> Plain:
    """PointCloud2.data: number of points, and smallest, largest and mean of each field over its
    finite values.
    """
    count = int(cloud.width) * int(cloud.height)
    summary: dict[str, Plain] = {"points": count, "bytes": len(cloud.data)}
    raw = np.frombuffer(cloud.data, dtype=np.uint8)
    step, row = (
        int(cloud.point_step),
        int(cloud.row_step) or int(cloud.point_step) * int(cloud.width),
    )
    if not count:
        return summary
    if step < 1 or row < step * int(cloud.width) or raw.size < row * int(cloud.height):
        summary["damaged"] = f"{raw.size} bytes do not hold {count} points of {step} bytes"
        return summary
    points = raw[: row * int(cloud.height)].reshape(int(cloud.height), row)[
        :, : step * int(cloud.width)
    ]
    points = np.ascontiguousarray(points).reshape(count, step)
    order = ">" if cloud.is_bigendian else "<"
    fields: dict[str, Plain] = {}
    for field in list(cloud.fields)[:16]:
        kind = _POINT_TYPES.get(int(field.datatype))
        size = np.dtype(kind).itemsize if kind else 0
        if not kind or int(field.offset) + size > step:
            fields[str(field.name)[:40]] = {
                "damaged": "outside of the point or of an unknown datatype"
            }
            continue
        column = np.ascontiguousarray(points[:, field.offset : field.offset + size]).view(
            order + kind
        )[:, 0]
        whole = summarize_numbers(column, ())
        assert isinstance(whole, dict)
        fields[str(field.name)[:40]] = {
            k: v for k, v in whole.items() if k not in ("length", "first")
        }
    summary["fields"] = fields
    return summary


def summarize_pixels(image: Image, limits: DecodeLimits) -> Plain:
    """Image.data and CompressedImage.data: only the length; the picture itself is sent as
    an image.
    """
    return {"length": len(image.data), "shown_as": "image"}


SUMMARIES: dict[tuple[str, str], Summarizer] = {
    ("sensor_msgs/msg/LaserScan", "ranges"): summarize_scan,
    ("sensor_msgs/msg/PointCloud2", "data"): summarize_cloud,
    ("sensor_msgs/msg/Image", "data"): summarize_pixels,
    ("sensor_msgs/msg/CompressedImage", "data"): summarize_pixels,
}
"""Fields with a special summary, by (message type, field)."""
