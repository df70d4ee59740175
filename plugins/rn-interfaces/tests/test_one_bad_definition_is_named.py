"""A definition that cannot be used is named with its file and what to do; all others are learnt."""

from __future__ import annotations

import gzip
import io
import os
import sys
import tarfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from made_packages import write_package
from mcap.writer import Writer

from rn_interfaces.definitions import outline
from rn_interfaces.finder import PREFIXES
from rn_interfaces.found import FoundDefinition, FoundDefinitions
from rn_interfaces.learning import Learnt, learn
from rn_interfaces.sizes import sizes
from rn_interfaces.sources import definitions
from rn_interfaces.store import MOST_TEXT, DefinitionStore, Name
from rn_interfaces_learning.command import Ros
from roboneuron import ConfigurationError

GOOD = "own_msgs/msg/Good"


@pytest.fixture
def empty(tmp_path: Path, user: Path, monkeypatch: pytest.MonkeyPatch) -> DefinitionStore:
    """A store of somebody else, who does not have this user's."""
    monkeypatch.setenv(PREFIXES, sys.prefix)
    return DefinitionStore(tmp_path / "store")


def taught(store: DefinitionStore, texts: dict[str, str]) -> Learnt:
    """Learn messages of a package `own_msgs`, with a good one."""
    found = FoundDefinitions()
    for word, text in {"Good": "float64 x\n", **texts}.items():
        found.add(Name("own_msgs", "msg", word), FoundDefinition(text, f"{word}.msg"))
    return learn(store, found)


def chain(count: int, line: str) -> dict[str, str]:
    """Messages that use each other, by a line with the earlier one's name."""
    return {f"M{i}": line.format(f"M{i - 1}") if i else "int8 x\n" for i in range(count)}


BAD = {
    "time of ROS 1": ("time stamp\n", "builtin_interfaces/Time stamp"),
    "duration of ROS 1": ("duration[] waits\n", "builtin_interfaces/Duration waits"),
    "Header of ROS 1": ("Header header\n", "std_msgs/Header header"),
    "unknown type": ("nobody_msgs/Thing thing\n", "nobody_msgs"),
    "type in small letters": ("thing a\n", "CamelCase"),
    "itself": ("Bad bad\n", "number or name"),
    "itself in a sequence": ("Bad[] bad\n", "number or name"),
    "field that is a word of Python": ("float64 from\n", "from_value"),
    "field in capitals": ("float64 Speed\n", "small letters"),
    "field twice": ("int8 a\nint8 a\n", "type name"),
    "field that hides a part of the class": ("int8 get_fields_and_field_types\n", "another name"),
    "fields that break the class": ("int8 builtins\nint8 b\n", "another name"),
    "field with a right-to-left mark": ("float64 a\u202eb\n", "small letters"),
    "field with a control character": ("float64 a\x1bb\n", "small letters"),
    "default -inf": ("float64 a -inf\n", "Leave the value out"),
    "constant -inf": ("float64 A=-inf\n", "Leave the value out"),
    "nan in an array": ("float64[2] a [nan, 1.0]\n", "Leave the value out"),
    "default that is no number": ("int8 a many\n", "type name"),
    "array too long": ("float64[99999999] a\n", "float64[] a"),
    "text too long": ("# " + "x" * MOST_TEXT, "comments"),
    "too many fields": ("".join(f"int8 a{i}\n" for i in range(2001)), "Split"),
}


def test_bad_messages_are_named_with_what_to_write(empty: DefinitionStore) -> None:
    texts = {"UsesGood": "Good[3] good\n", "None": "int8 a\n", "True": "int8 a\n"}
    words = {f"Bad{number}": case for number, case in enumerate(BAD)}
    for word, case in words.items():
        texts[word] = BAD[case][0].replace("Bad", word)
        texts[f"Uses{word}"] = f"{word} bad\n"
    learnt = taught(empty, texts)
    assert {str(name) for name in learnt.added} == {GOOD, "own_msgs/msg/UsesGood"}
    assert {str(name) for name in empty.names()} == {str(name) for name in learnt.added}
    for word, case in words.items():
        bad = learnt.refused[f"own_msgs/msg/{word}"]
        assert BAD[case][1] in bad.instead, case
        assert bad.source == f"{word}.msg"
        assert bad.reason.isprintable()
        assert bad.reason.endswith(".")
        assert word in learnt.refused[f"own_msgs/msg/Uses{word}"].reason
    assert len(learnt.refused) == 2 * len(BAD) + 2  # None and True


def test_what_cannot_be_used_spreads_through_a_diamond(empty: DefinitionStore) -> None:
    bad = {"A": "missing_msgs/Thing t\n", "C": "A a\n", "B": "A a\nC c\n", "D": "B b\nC c\nA a\n"}
    learnt = taught(empty, bad)
    assert {name.rpartition("/")[2] for name in learnt.refused} == set(bad)
    assert {str(name) for name in learnt.added} == {GOOD}


def test_circles_are_named_and_what_uses_them(empty: DefinitionStore) -> None:
    learnt = taught(empty, {"A": "B b\n", "B": "C[] c\n", "C": "A a\nGood g\n", "D": "A a\n"})
    assert "A -> own_msgs/msg/B -> own_msgs/msg/C" in learnt.refused["own_msgs/msg/A"].reason
    assert len(learnt.refused) == 4
    assert {str(name) for name in learnt.added} == {GOOD}


@pytest.mark.parametrize(
    ("line", "kept"),
    [
        ("{} a\n", 32),  # levels
        ("{}[] a\n", 32),
        ("{0} a\n{0} b\n", 13),  # "billion laughs"
        ("{}[1000] a\n", 2),
        ("{}[<=1000] a\n", 32),
    ],
)
def test_depth_and_growth_are_bounded(line: str, kept: int) -> None:
    names = {Name("own_msgs", "msg", word): text for word, text in chain(300, line).items()}
    outlines = {name: outline(name, text) for name, text in names.items()}
    found = sizes(outlines, names)
    good = {name for name, size in found.items() if not size.excess()}
    assert {name.word for name in good} == {f"M{i}" for i in range(kept)}


def test_what_is_too_large_is_refused_and_the_rest_learnt(empty: DefinitionStore) -> None:
    learnt = taught(empty, chain(300, "{0}[9] a\n{0}[9] b\n"))
    assert {name.word for name in learnt.added} == {"Good", "M0", "M1", "M2", "M3"}
    assert len(learnt.refused) == 296


def test_numbers_in_fixed_arrays_are_bounded(empty: DefinitionStore) -> None:
    learnt = taught(empty, {"A": "float64[1000000] a\n", "B": "A[5] b\n", "C": "A[4] b\n"})
    assert learnt.refused.keys() == {"own_msgs/msg/B"}


SPECIAL: dict[str, tuple[str, dict[str, float]]] = {
    "Nan": ("float64 a nan\nfloat32 b inf\nfloat64 C=nan\n", {"b": float("inf")}),
    "Words": ("int8 register 3\nint8 union\nint8 struct\nint8 self\nint8 property\n", {"union": 0}),
    "Nans": ("float64 nan 3.0\nfloat64 b inf\n", {"nan": 3.0, "b": float("inf")}),
}


def test_unusual_names_and_values_work(user: Path) -> None:
    found = FoundDefinitions()
    for word, (text, _) in SPECIAL.items():
        found.add(Name("unusual_msgs", "msg", word), FoundDefinition(text, "a test"))
    learnt = learn(DefinitionStore(), found)
    assert not learnt.refused
    module = import_module("unusual_msgs.msg")
    for word, (_, values) in SPECIAL.items():
        message = getattr(module, word)()
        assert {name: getattr(message, name) for name in values} == values
    assert module.Nan().a != module.Nan().a
    assert module.Nan.C != module.Nan.C


def test_two_definitions_of_a_type_are_both_refused_unless_they_say_the_same() -> None:
    found = FoundDefinitions()
    seam, same = Name("a_msgs", "msg", "Seam"), Name("a_msgs", "msg", "Same")
    found.add(seam, FoundDefinition("int8 a\n", "one"))
    found.add(seam, FoundDefinition("int16 a\n", "two"))
    found.add(seam, FoundDefinition("int8 a\n", "one"))
    found.add(same, FoundDefinition("# what it is\n\nint8  a # [m]\n", "one"))
    found.add(same, FoundDefinition("int8 a\n", "two"))
    assert found.texts.keys() == {same}
    assert found.refused[str(seam)].source == "one, two"


def special(folder: Path) -> None:
    """Files besides good_msgs/msg/Good.msg that are none."""
    msg = folder / "good_msgs" / "msg"
    msg.mkdir(parents=True)
    (msg / "Good.msg").write_text("float64 x\n")
    (msg / "Good.idl").write_text("generated from it")
    (msg / "Latin.msg").write_bytes("# Gr\xf6\xdfe\nfloat64 x\n".encode("latin-1"))
    (msg / "small.msg").write_text("float64 x\n")
    (msg / "Turn\u202egsm.msg").write_text("float64 x\n")
    (msg / "Escape\x1b[2J.msg").write_text("float64 x\n")
    (msg / "Only.idl").write_text("module good_msgs {};")
    (msg / "Large.msg").write_text("# " + "x" * MOST_TEXT)
    (msg / "Folder.msg").mkdir()
    (msg / "Zero.msg").symlink_to("/dev/zero")
    (msg / "Lost.msg").symlink_to("nowhere.msg")
    os.mkfifo(msg / "Pipe.msg")
    (folder / "Loose.msg").write_text("float64 x\n")


NAMED = {
    "Latin.msg": "iconv",
    "small.msg": "CamelCase",
    "Turn\\u202egsm.msg": "CamelCase",
    "Escape\\x1b[2J.msg": "CamelCase",
    "Only.idl": ".msg",
    "Large.msg": "regular file",
    "Zero.msg": "regular file",
    "Pipe.msg": "regular file",
    "Lost.msg": "",
    "Loose.msg": "PACKAGE/msg/Loose.msg",
}


def test_files_that_give_no_definition_are_named(tmp_path: Path) -> None:
    special(tmp_path / "src")
    found = definitions(tmp_path / "src")
    assert {str(name) for name in found.texts} == {"good_msgs/msg/Good"}
    named = {file.rpartition("/")[2]: one for file, one in found.refused.items()}
    assert named.keys() == NAMED.keys()
    for file, instead in NAMED.items():
        assert instead in named[file].instead


def test_members_of_a_tarball_that_give_none_are_named(tmp_path: Path) -> None:
    special(tmp_path / "src")
    with tarfile.open(tmp_path / "src.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "src", "src")
    found = definitions(tmp_path / "src.tar.gz")
    assert {str(name) for name in found.texts} == {"good_msgs/msg/Good"}
    assert {file.rpartition("/")[2] for file in found.refused} == NAMED.keys()


def test_a_damaged_tarball_is_named_and_gives_what_it_has(tmp_path: Path) -> None:
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for word in ("A", "B"):
            member = tarfile.TarInfo(f"own_msgs/msg/{word}.msg")
            member.size = 8
            archive.addfile(member, io.BytesIO(b"int8 aa\n"))
    (tmp_path / "cut.tar").write_bytes(data.getvalue()[: 512 * 3 + 3])
    found = definitions(tmp_path / "cut.tar")
    assert {str(name) for name in found.texts} == {"own_msgs/msg/A"}
    assert str(tmp_path / "cut.tar/own_msgs/msg/B.msg") in found.refused
    (tmp_path / "cut.tgz").write_bytes(gzip.compress(data.getvalue())[:-20])
    assert str(tmp_path / "cut.tgz") in definitions(tmp_path / "cut.tgz").refused
    (tmp_path / "text.tar.gz").write_text("no tarball")
    assert not definitions(tmp_path / "text.tar.gz").texts


def test_sources_that_are_no_files_are_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    os.mkfifo(tmp_path / "pipe.msg")
    for path in (tmp_path / "pipe.msg", Path("/dev/zero"), tmp_path / "no", tmp_path / "empty"):
        with pytest.raises(ConfigurationError):
            definitions(path)


Schemas = list[tuple[str, str, bytes]]
WELD = ("weld_msgs/msg/Weld", "ros2msg", b"int8 a\n")
RULE = "=" * 80
RECORDINGS: dict[str, tuple[Schemas, set[str], set[str]]] = {
    "name without a package": ([WELD, ("Weld", "ros2msg", b"int8 a\n")], {WELD[0]}, {"Weld"}),
    "empty name": ([WELD, ("", "", b"")], {WELD[0]}, {""}),
    "name of ROS 1": ([("weld_msgs/Weld", "ros2msg", b"int8 a\n")], {WELD[0]}, set()),
    "other encodings": (
        [WELD, *((f"a/msg/{e.title()}", e, b"int8 a\n") for e in
         ("ros1msg", "protobuf", "jsonschema", "ros2idl", "omgidl", "flatbuffer"))],
        {WELD[0]},
        {f"a/msg/{e}" for e in
         ("Ros1Msg", "Protobuf", "Jsonschema", "Ros2Idl", "Omgidl", "Flatbuffer")},
    ),
    "not UTF-8": ([WELD, ("a/msg/B", "ros2msg", b"# \xff\n")], {WELD[0]}, {"a/msg/B"}),
    "two definitions": (
        [WELD, ("a/msg/B", "ros2msg", b"int8 a\n"), ("a/msg/B", "ros2msg", b"int16 a\n")],
        {WELD[0]},
        {"a/msg/B"},
    ),
    "two definitions inside others": (
        [("a/msg/B", "ros2msg", f"C c\n{RULE}\nMSG: a/C\nint8 c\n".encode()),
         ("a/msg/D", "ros2msg", f"C c\n{RULE}\nMSG: a/C\nint16 c\n".encode())],
        {"a/msg/B", "a/msg/D"},
        {"a/msg/C"},
    ),
    "escapes in a name": ([WELD, ("\x1b[2J", "ros2msg", b"")], {WELD[0]}, {"\\x1b[2J"}),
}  # fmt: skip


def recording(path: Path, schemas: Schemas) -> Path:
    """Write an MCAP file with these schemas."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        for schema in schemas:
            writer.register_schema(*schema)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize("case", RECORDINGS)
def test_bad_schemas_of_a_recording_are_named(case: str, tmp_path: Path) -> None:
    schemas, names, refused = RECORDINGS[case]
    found = definitions(recording(tmp_path / "a.mcap", schemas))
    assert {str(name) for name in found.texts} == names
    assert found.refused.keys() == refused


@pytest.mark.parametrize(
    ("damage", "is_one"),
    [
        (lambda data: b"", False),
        (lambda data: b"a text\n", False),
        (lambda data: data[:8], False),
        (lambda data: data[:-20], True),
        (lambda data: data[: len(data) // 2], True),
        (lambda data: data.replace(b"ros2msg", b"ros2ms\xff"), True),
    ],
)
def test_a_damaged_recording_is_named(
    damage: Callable[[bytes], bytes], is_one: bool, tmp_path: Path
) -> None:
    path = recording(tmp_path / "a.mcap", [WELD])
    path.write_bytes(damage(path.read_bytes()))
    if not is_one:
        with pytest.raises(ConfigurationError, match="no MCAP file"):
            definitions(path)
        return
    assert str(path) in definitions(path).refused


def test_the_command_names_bad_ones_learns_the_rest_and_says_so(
    user: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv(PREFIXES, sys.prefix)
    special(tmp_path / "src")
    uses = write_package(tmp_path, "uses_msgs", {"msg/Uses.msg": "good_msgs/Good good\n"})
    assert learning(uses, tmp_path / "src") == 1
    printed = capsys.readouterr().out
    assert printed.endswith(f"2 learnt, 0 known, {len(NAMED)} refused.\n")
    assert all(file in printed for file in NAMED)
    assert printed.replace("\n", "").isprintable()
    assert learning(uses, tmp_path / "src" / "good_msgs" / "msg" / "Good.msg") == 0


def learning(*sources: Path) -> int:
    """Exit status of `roboneuron ros learn`."""
    from argparse import ArgumentParser

    parser = ArgumentParser()
    command = Ros()
    command.configure(parser)
    return command.run(parser.parse_args(["learn", *map(str, sources)]))
