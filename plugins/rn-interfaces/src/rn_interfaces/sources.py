"""Definitions in folders, tarballs and MCAP files."""

from __future__ import annotations

import lzma
import os
import re
import stat
import tarfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from rn_interfaces.found import FoundDefinition, FoundDefinitions, Refusal
from rn_interfaces.recordings import of_mcap
from rn_interfaces.store import KINDS, MOST_INTERFACES, MOST_TEXT, parse_name
from roboneuron import ConfigurationError

_PACKAGE_NAME = re.compile(r"<name>\s*([a-z][a-z0-9_]*)\s*</name>")
_TARBALLS = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2")
_OF_PACKAGE = "package.xml"
_IDL = ".idl"
_DAMAGED = (tarfile.TarError, EOFError, zlib.error, lzma.LZMAError)


class _FileError(Exception):
    """A file that cannot be read, with the reason."""


File = tuple[PurePosixPath, Callable[[], bytes]]
"""Path below the source, and its content; which raises _FileError or OSError."""


def definitions(path: Path) -> FoundDefinitions:
    """Return all definitions of a folder, tarball, MCAP file, or single definition, and what is
    in it that is none.

    Raises
    ------
    ConfigurationError
        There is no such file, it cannot be read, or has nothing of the kind.
    """
    path = path.expanduser()
    try:
        found = _found(path)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror or error}.") from error
    if not found.texts and not found.refused:
        raise ConfigurationError(
            f"{path} has no ROS interfaces.",
            hint="Expected are files such as weld_msgs/msg/Seam.msg, as in a workspace's src, or "
            "an MCAP file of a ROS 2 recording.",
        )
    return found


def _found(path: Path) -> FoundDefinitions:
    if path.is_dir():
        return _named(_files(path), path)
    if not path.exists():
        raise ConfigurationError(f"There is no {path}.")
    if not path.is_file():
        raise ConfigurationError(f"{path} is no regular file.")
    if path.name.endswith(_TARBALLS):
        return _named(_members(path), path)
    if path.suffix == ".mcap":
        return of_mcap(path)
    absolute = path.resolve()
    file = PurePosixPath(*absolute.parts[-3:])
    return _named([(file, lambda: _read(absolute))], absolute.parents[2])


def _files(folder: Path) -> Iterator[File]:
    base = folder.resolve().name
    for place, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            path = Path(place, name)
            yield PurePosixPath(base, path.relative_to(folder)), lambda path=path: _read(path)  # type: ignore[misc]


def _read(path: Path) -> bytes:
    """Content of a regular file; others, such as pipes and devices, could block or never end."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise _FileError("It is no regular file.")
        return _checked(file.read(MOST_TEXT + 1))


def _checked(data: bytes) -> bytes:
    if len(data) > MOST_TEXT:
        raise _FileError(f"It has more than {MOST_TEXT} bytes.")
    return data


def _members(path: Path) -> Iterator[File]:
    """Files of a tarball up to where it is damaged, which is then raised as _FileError."""
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                if member.isdir():
                    continue

                def read(member: tarfile.TarInfo = member) -> bytes:
                    if not member.isfile():
                        raise _FileError("It is no regular file.")
                    file = archive.extractfile(member)
                    assert file is not None  # it is a file
                    try:
                        return _checked(file.read(MOST_TEXT + 1))
                    except _DAMAGED as error:
                        raise _FileError(f"The tarball is damaged: {error}.") from error

                yield PurePosixPath(member.name), read
    except _DAMAGED as error:
        raise _FileError(f"The tarball is damaged: {error}.") from error


def _named(files: Iterable[File], source: Path) -> FoundDefinitions:
    """The package is that of a package.xml beside the folder of the kind, else the folder."""
    found = FoundDefinitions()
    texts: dict[PurePosixPath, str] = {}
    packages: dict[PurePosixPath, str] = {}
    others: dict[PurePosixPath, Refusal] = {}
    try:
        for path, read in files:
            if path.name == _OF_PACKAGE:
                named = _PACKAGE_NAME.search(_text(read, others, path) or "")
                if named is not None:
                    packages[path.parent] = named[1]
            elif path.suffix[1:] in KINDS:
                text = _text(read, others, path)
                if text is not None:
                    texts[path] = text
            elif path.suffix == _IDL and path.parent.name in KINDS:
                others[path] = Refusal(
                    "It is written in IDL, which is not learnt.",
                    f"Write it as a file .{path.parent.name}, with one `type name` a line.",
                )
            if len(texts) > MOST_INTERFACES:
                raise ConfigurationError(f"{source} has more than {MOST_INTERFACES} interfaces.")
    except _FileError as error:
        found.refused[str(source)] = Refusal(str(error), "Copy it again from where it is whole.")
    for path, text in texts.items():
        _add(found, path, text, packages, source)
    generated = {path.with_suffix(_IDL) for path in texts}  # beside what it was generated from
    for path, refusal in others.items():
        if path not in generated:
            found.refused[_place(source, path)] = refusal
    return found


def _text(
    read: Callable[[], bytes], refused: dict[PurePosixPath, Refusal], path: PurePosixPath
) -> str | None:
    try:
        return read().decode()
    except UnicodeDecodeError as error:
        refused[path] = Refusal(
            f"It is not UTF-8: byte {error.start} is {error.object[error.start]:#04x}.",
            f"Save it as UTF-8, such as with `iconv -f latin1 -t utf-8 {path.name}`.",
        )
    except _FileError as error:
        refused[path] = Refusal(str(error), "Put a regular file of that size at most there.")
    except OSError as error:
        refused[path] = Refusal(f"It cannot be read: {error.strerror or error}.")
    return None


def _add(
    found: FoundDefinitions,
    path: PurePosixPath,
    text: str,
    packages: dict[PurePosixPath, str],
    source: Path,
) -> None:
    place = _place(source, path)
    kind = path.suffix[1:]
    if path.parent.name != kind:
        found.refused[place] = Refusal(
            f"It is not in a folder called {kind!r}, so its package is not known.",
            f"Put it at PACKAGE/{kind}/{path.name}.",
        )
        return
    folder = path.parents[1]
    package = packages.get(folder, folder.name)
    try:
        name = parse_name(f"{package}/{kind}/{path.stem}")
    except ConfigurationError as error:
        found.refused[place] = Refusal(
            error.message,
            "Name packages in small letters, digits and underscores, and interfaces in CamelCase: "
            f"such as weld_msgs/{kind}/Seam.{kind}.",
        )
        return
    found.add(name, FoundDefinition(text, place))


def _place(source: Path, path: PurePosixPath) -> str:
    """Name of a file for people, without characters that a terminal would act on."""
    whole = source.resolve().parent / path if source.is_dir() else source.resolve() / path
    return repr(str(whole))[1:-1]
