"""Compile the C functions of rn-interfaces and write their bytes where they are mapped from.

    python tools/native_code.py

Needs gcc and binutils on x86-64; see plugins/rn-interfaces/src/rn_interfaces/native.c.
"""

from __future__ import annotations

import base64
import hashlib
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

FOLDER = Path(__file__).parents[1] / "plugins" / "rn-interfaces" / "src" / "rn_interfaces"
FLAGS = (
    *("-std=c11", "-Os", "-fPIC", "-ffreestanding", "-mgeneral-regs-only", "-Wall", "-Wextra"),
    *("-Werror", "-fno-jump-tables", "-fno-stack-protector", "-fcf-protection=none"),
    *("-fno-asynchronous-unwind-tables", "-fno-tree-loop-distribute-patterns"),
)
"""No tables beside the code, and no calls that would have to be linked."""
WIDTH = 90


def run(*command: str | Path) -> str:
    """Standard output of a command. Raises CalledProcessError."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def main() -> None:
    """Write `machine_code.py`."""
    digest = hashlib.sha256((FOLDER / "native.c").read_bytes()).hexdigest()
    with TemporaryDirectory() as scratch:
        made, binary = Path(scratch, "native.o"), Path(scratch, "native.bin")
        run("gcc", *FLAGS, "-c", FOLDER / "native.c", "-o", made)
        if "R_X86_64" in run("readelf", "-r", made):
            raise SystemExit("The code has relocations; call only static functions.")
        run("objcopy", "-O", "binary", "-j", ".text", made, binary)
        symbols = [line.split() for line in run("nm", made).splitlines()]
        code = base64.b64encode(binary.read_bytes()).decode()
    entries = sorted((int(place, 16), name) for place, kind, name in symbols if kind == "T")
    lines = [f'    "{name}": {place},' for place, name in entries]
    pieces = [code[start : start + WIDTH] for start in range(0, len(code), WIDTH)]
    text = "\n".join(f'    "{piece}"' for piece in pieces)
    (FOLDER / "machine_code.py").write_text(
        '"""Bytes of native.c for x86-64, written by tools/native_code.py."""\n\n'
        f"X86_64 = (\n{text}\n)\n"
        '"""Base 64."""\n'
        "ENTRIES = {\n" + "\n".join(lines) + "\n}\n"
        '"""Offset of each function [B]."""\n'
        f'SOURCE = "{digest}"\n'
        '"""SHA-256 of native.c."""\n',
        encoding="utf-8",
    )


if __name__ == "__main__":
    main()
