"""The compiled library of native.c: that of the wheel, or one compiled once per user of a checkout.

It needs the standard library only, because `hatch_build.py` compiles the wheel's library with it.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory

SOURCE = Path(__file__).with_name("native.c")
SHIPPED = Path(__file__).with_name("_native.so")
"""Library in a wheel."""
FLAGS = ("-std=c11", "-O2", "-shared", "-fPIC", "-Wall", "-Werror", "-fvisibility=hidden")
GLIBC = (2, 17)
"""Oldest supported glibc of a wheel: manylinux2014, which pip supports since 2019."""
_TIMEOUT_S = 60.0
_PRIVATE = 0o700
_OPEN_TO_OTHERS = 0o077
_WRITABLE_BY_OTHERS = 0o022


class LibraryError(RuntimeError):
    """There is no library, and none can be compiled; the message contains a remedy."""


def find_library(source: Path = SOURCE, shipped: Path = SHIPPED) -> Path:
    """The library of a wheel; in a checkout that of the user's cache, compiled where it is missing.

    Raises
    ------
    LibraryError
        There is no compiler, it fails, or others could have written what is in the cache.
    """
    if shipped.is_file():
        return shipped
    place = cached_library(source)
    try:
        _check_folder(place.parent)
        if not os.path.lexists(place):
            with TemporaryDirectory(dir=place.parent, prefix=".new-") as scratch:
                made = Path(scratch, place.name)
                compile_library(source, made)
                os.replace(made, place)
        _check_file(place)
    except OSError as error:
        raise LibraryError(
            f"{place} cannot be made: {error}. Set XDG_CACHE_HOME to a folder of yours."
        ) from error
    return place


def cached_library(source: Path = SOURCE) -> Path:
    """Path of a source's library for this user and processor, whether compiled or not."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    made_of = (source.read_bytes(), " ".join(FLAGS).encode(), platform.machine().encode())
    digest = hashlib.sha256(b"\0".join(made_of)).hexdigest()
    return Path(base) / "roboneuron" / f"rn-interfaces-{digest}.so"


def compile_library(source: Path, to: Path) -> None:
    """Compile a library that only its user can write.

    Raises
    ------
    LibraryError
        There is no compiler, or it fails.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise LibraryError(
            f"There is no C compiler (cc) to compile {source} with: type `apt-get install gcc`, or "
            "install a wheel of rn-interfaces, which holds the library."
        )
    command = [compiler, *FLAGS, str(source), "-o", str(to)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_TIMEOUT_S)
    except (subprocess.SubprocessError, OSError) as error:
        told = getattr(error, "stderr", None) or str(error)
        raise LibraryError(f"{compiler} does not compile {source}: {told}") from error
    to.chmod(_PRIVATE)


def wheel_platform(made: Path) -> str:
    """Platform tag of the wheel with a library: manylinux, which package indexes require, if it
    needs no newer glibc; else that of this system.
    """
    versions = re.findall(rb"GLIBC_(\d+)\.(\d+)", made.read_bytes())
    newest = max(((int(major), int(minor)) for major, minor in versions), default=(0, 0))
    if platform.libc_ver()[0] == "glibc" and newest <= GLIBC:
        return f"manylinux_{GLIBC[0]}_{GLIBC[1]}_{platform.machine()}"
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")


def _check_folder(folder: Path) -> None:
    """Create a folder that is closed to others, or close it."""
    folder.mkdir(mode=_PRIVATE, parents=True, exist_ok=True)
    facts = folder.stat()
    if facts.st_uid != os.geteuid():
        raise _not_yours(folder)
    if facts.st_mode & _OPEN_TO_OTHERS:
        folder.chmod(_PRIVATE)


def _check_file(path: Path) -> None:
    facts = path.lstat()  # the mode of a link permits writing to all
    if facts.st_uid != os.geteuid() or facts.st_mode & _WRITABLE_BY_OTHERS:
        raise _not_yours(path)


def _not_yours(path: Path) -> LibraryError:
    return LibraryError(
        f"{path} is not loaded, because it belongs to another user or others may write it. "
        "Delete it, or set XDG_CACHE_HOME to a folder of yours."
    )
