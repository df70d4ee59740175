"""Definitions that tests learn."""

from __future__ import annotations

from pathlib import Path

WELD = {
    "msg/Seam.msg": "# A seam.\nstd_msgs/Header header\nfloat64[3] offset  # [m]\n"
    'float64[] currents\nstring<=16 tool "tig"\nuint8[<=4] flags\nint32 MAX=7\n',
    "msg/Path.msg": "Seam[] seams\nwstring note\nbool[2] done\nbyte mark\nEmptyPart nothing\n",
    "msg/EmptyPart.msg": "",
    "srv/Strike.srv": "Seam seam\nbool dry\n---\nbool success\nstring message\n",
    "action/Weld.action": "Seam seam\n---\nfloat32 length\n---\nfloat32 done\n",
}


def write_package(folder: Path, package: str, files: dict[str, str]) -> Path:
    """Write definitions as a package's folder has them."""
    for name, text in files.items():
        path = folder / package / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder / package
