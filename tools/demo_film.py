"""Reduce the film of `make demo` in out/demo/ to the size shown in the README and the
documentation.

    python tools/demo_film.py out/demo/film.gif docs/assets/demo.webp

It is stored as WebP, 448 px wide; a file above 1.5 MB is refused.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image, ImageSequence

MAX_BYTES = 1_500_000
WIDTH_PX = 448


def reduce_film(source: Path, target: Path) -> int:
    """Write `target` from `source`; return its size in bytes.

    Raises:
        SystemExit: the result is above MAX_BYTES.
    """
    frames: list[Image.Image] = []
    durations_ms: list[int] = []
    with Image.open(source) as film:
        for frame in ImageSequence.Iterator(film):
            height_px = round(frame.height * WIDTH_PX / frame.width)
            frames.append(
                frame.convert("RGB").resize((WIDTH_PX, height_px), Image.Resampling.LANCZOS)
            )
            durations_ms.append(int(frame.info.get("duration", 40)))
    frames[0].save(
        target,
        save_all=True,
        append_images=frames[1:],
        duration=durations_ms,
        loop=0,
        quality=75,
        method=6,
    )
    size = target.stat().st_size
    if size > MAX_BYTES:
        target.unlink()
        raise SystemExit(f"{target} would take {size} bytes, allowed are {MAX_BYTES}.")
    return size


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    arguments = parser.parse_args()
    print(f"{arguments.target}: {reduce_film(arguments.source, arguments.target)} bytes")
