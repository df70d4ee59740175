"""Definitions in folders, tarballs and MCAP files."""

from __future__ import annotations

import re
import tarfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path, PurePosixPath

from rn_interfaces.learning import FoundDefinition
from rn_interfaces.store import KINDS, MOST_INTERFACES, MOST_TEXT, Name, parse_name
from roboneuron import ConfigurationError

_PACKAGE_NAME = re.compile(r"<name>\s*([a-z][a-z0-9_]*)\s*</name>")
_RULE = re.compile(r"^={80}\n", re.MULTILINE)
_TARBALLS = (".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2")
_OF_PACKAGE = "package.xml"


def definitions(path: Path) -> dict[Name, FoundDefinition]:
    """Return all definitions of a folder, tarball, MCAP file, or single definition.

    Raises
    ------
    ConfigurationError
        There is no such file, it cannot be read, or it has none.
    """
    try:
        found = _found(path.expanduser())
    except (OSError, tarfile.TarError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}.") from error
    if not found:
        raise ConfigurationError(
            f"{path} has no ROS interfaces.",
            hint="Expected are files such as weld_msgs/msg/Seam.msg, as in a workspace's src, or "
            "an MCAP file of a ROS 2 recording.",
        )
    return found


def _found(path: Path) -> dict[Name, FoundDefinition]:
    if path.is_dir():
        files = (file for kind in (*KINDS, "xml") for file in path.rglob(f"*.{kind}"))
        return _named(
            ((file.relative_to(path.parent).as_posix(), file.read_bytes) for file in files),
            path,
        )
    if not path.is_file():
        raise ConfigurationError(f"There is no {path}.")
    if path.name.endswith(_TARBALLS):
        with tarfile.open(path) as archive:
            return _named(_members(archive), path)
    if path.suffix == ".mcap":
        return _of_mcap(path)
    absolute = path.resolve()
    name = "/".join(absolute.parts[-3:])
    return _named([(name, absolute.read_bytes)], path)


def _members(archive: tarfile.TarFile) -> Iterator[tuple[str, Callable[[], bytes]]]:
    for member in archive:
        if not member.isfile() or member.size > MOST_TEXT:
            continue

        def read(member: tarfile.TarInfo = member) -> bytes:
            file = archive.extractfile(member)
            assert file is not None  # it is a file
            return file.read()

        if PurePosixPath(member.name).suffix[1:] in (*KINDS, "xml"):
            yield member.name, read


def _named(
    files: Iterable[tuple[str, Callable[[], bytes]]], source: Path
) -> dict[Name, FoundDefinition]:
    """The package is that of a package.xml beside the folder of the kind, else the folder."""
    texts: dict[PurePosixPath, str] = {}
    packages: dict[PurePosixPath, str] = {}
    for name, read in files:
        path = PurePosixPath(name)
        if path.name == _OF_PACKAGE:
            named = _PACKAGE_NAME.search(read().decode("utf-8", "replace"))
            if named is not None:
                packages[path.parent] = named[1]
        elif path.suffix[1:] in KINDS and path.parent.name == path.suffix[1:]:
            texts[path] = read().decode()
        if len(texts) > MOST_INTERFACES:
            raise ConfigurationError(f"{source} has more than {MOST_INTERFACES} interfaces.")
    found: dict[Name, FoundDefinition] = {}
    for path, text in texts.items():
        folder = path.parents[1]
        package = packages.get(folder, folder.name)
        interface = parse_name(f"{package}/{path.parent.name}/{path.stem}")
        found[interface] = FoundDefinition(text, f"{source.resolve()}")
    return found


def _of_mcap(path: Path) -> dict[Name, FoundDefinition]:
    from mcap.exceptions import McapError
    from mcap.records import Schema
    from mcap.stream_reader import StreamReader

    found: dict[Name, FoundDefinition] = {}
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Schema) and record.encoding == "ros2msg":
                    found.update(_of_schema(record.name, record.data.decode(), path))
    except McapError as error:
        raise ConfigurationError(f"{path} is no MCAP file: {error}.") from error
    return found


def _of_schema(name: str, data: str, path: Path) -> dict[Name, FoundDefinition]:
    """The definition, and those of all types that it uses."""
    first, *others = _RULE.split(data)
    found = {parse_name(name): FoundDefinition(first, str(path))}
    for part in others:
        head, _, text = part.partition("\n")
        package, _, word = head.removeprefix("MSG: ").strip().rpartition("/")
        found[parse_name(f"{package.removesuffix('/msg')}/msg/{word}")] = FoundDefinition(
            text, str(path)
        )
    return found
