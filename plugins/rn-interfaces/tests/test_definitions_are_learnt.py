"""Definitions from folders, tarballs, recordings and rosbags: kept, or refused with a reason."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest
from made_packages import WELD, write_package
from mcap.writer import Writer

from rn_interfaces.finder import PREFIXES
from rn_interfaces.found import FoundDefinition, FoundDefinitions
from rn_interfaces.learning import Learnt, learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import MOST_TEXT, DefinitionStore, Name, parse_name
from rn_interfaces_learning.processes import definition_of, prefixes_of_processes
from roboneuron import ConfigurationError

SEAM = Name("weld_msgs", "msg", "Seam")


@pytest.fixture
def empty(tmp_path: Path, user: Path, monkeypatch: pytest.MonkeyPatch) -> DefinitionStore:
    """A store of somebody else, who does not have this user's."""
    monkeypatch.setenv(PREFIXES, sys.prefix)
    return DefinitionStore(tmp_path / "store")


def taught(store: DefinitionStore, **texts: str) -> Learnt:
    """Learn messages of a package `own_msgs`."""
    found = FoundDefinitions()
    for word, text in texts.items():
        found.add(Name("own_msgs", "msg", word), FoundDefinition(text, "a test"))
    return learn(store, found)


def test_a_folder_and_a_tarball_give_the_same(tmp_path: Path) -> None:
    folder = write_package(tmp_path / "src", "any_folder", WELD)
    (folder / "package.xml").write_text("<package><name>weld_msgs</name></package>")
    with tarfile.open(tmp_path / "src.tar.gz", "w:gz") as archive:
        archive.add(folder, "src/any_folder")
    found = definitions(tmp_path / "src").texts
    assert {str(name) for name in found} == {
        *(f"weld_msgs/msg/{word}" for word in ("Seam", "Path", "EmptyPart")),
        "weld_msgs/srv/Strike",
        "weld_msgs/action/Weld",
    }
    packed = definitions(tmp_path / "src.tar.gz").texts
    assert {n: t.text for n, t in packed.items()} == {n: t.text for n, t in found.items()}
    assert definitions(folder / "msg" / "EmptyPart.msg").texts.keys() == {
        Name("any_folder", "msg", "EmptyPart")
    }


def test_a_recording_gives_its_schemas(tmp_path: Path, empty: DefinitionStore) -> None:
    path = tmp_path / "weld.mcap"
    rule = "=" * 80
    text = f"Seam[] seams\n{rule}\nMSG: weld_msgs/Seam\nint32 number\n"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.register_schema("weld_msgs/msg/Welds", "ros2msg", text.encode())
        writer.finish()
    learnt = learn(empty, definitions(path))
    assert {name.word for name in learnt.added} == {"Welds", "Seam"}


def test_what_is_no_definition_is_refused_and_the_rest_is_kept(empty: DefinitionStore) -> None:
    learnt = taught(
        empty,
        Good="int32 number\n",
        Bad="int3 number\n",
        OnBad="Bad bad\n",
        Lost="nobody_msgs/Thing thing\n",
        Absent="std_msgs/NoSuch thing\n",
        Huge="float64[99999999] numbers\n",
        Long="# " + "x" * MOST_TEXT,
    )
    assert [name.word for name in learnt.added] == ["Good"]
    reasons = {name.rpartition("/")[2]: one.reason for name, one in learnt.refused.items()}
    assert "is no definition" in reasons["Bad"]
    assert "own_msgs/msg/Bad" in reasons["OnBad"]
    assert "nobody_msgs/msg/Thing, which is not known" in reasons["Lost"]
    assert "std_msgs/msg/NoSuch" in reasons["Absent"]
    assert "99999999 elements" in reasons["Huge"]
    assert "bytes of text" in reasons["Long"]
    assert [str(name) for name in empty.names()] == ["own_msgs/msg/Good"]


def test_compiled_packages_are_left_alone(empty: DefinitionStore) -> None:
    own = FoundDefinition("int32 a\n", "a test")
    learnt = learn(empty, FoundDefinitions(texts={Name("std_msgs", "msg", "Own"): own}))
    assert learnt.compiled == {"std_msgs"}
    assert not empty.names()


def test_a_hash_that_the_node_does_not_have_is_refused(empty: DefinitionStore) -> None:
    wrong = "RIHS01_" + "0" * 64
    told = FoundDefinition("int32 a\n", "node /welder", {str(SEAM): wrong})
    learnt = learn(empty, FoundDefinitions(texts={SEAM: told}))
    assert f"the node says {wrong}" in learnt.refused[str(SEAM)].reason
    assert not empty.names()


def test_missing_messages_come_from_rosbags(empty: DefinitionStore) -> None:
    taught(empty, Frames="tf2_msgs/TFMessage frames\n")
    origins = empty.origins()
    assert origins["tf2_msgs/msg/TFMessage"].source.startswith("rosbags")
    assert origins["own_msgs/msg/Frames"].source == "a test"


def test_another_text_changes_what_uses_it(empty: DefinitionStore) -> None:
    first = taught(empty, Part="int32 a\n", Whole="Part part\n")
    again = taught(empty, Part="int32 a\n")
    assert (len(again.added), len(again.known)) == (0, 1)
    changed = taught(empty, Part="int64 a\n")
    assert {name.word for name in changed.added} == {"Part", "Whole"}
    assert set(changed.added.values()).isdisjoint(first.added.values())
    assert empty.forget("own_msgs") == 2
    assert not empty.names()
    assert not empty.origins()


@pytest.mark.parametrize("name", ["std_msgs/Header", "../msg/A", "a/msg/../B", "a/msg/a", "a/x/A"])
def test_names_that_are_none_are_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match="not the name of an interface"):
        parse_name(name)


def test_text_of_strangers_is_never_run(user: Path, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    code = f"open('{mark}', 'w')"
    quoted = code.replace("'", "\\'")
    learnt = taught(
        DefinitionStore(),
        Quotes=f"string A='' + str({code}) + ''\n",
        Double=f"string B=\"'+str({quoted})+'\"\n",
        Slashes=f"string c '\\\\\"+str({quoted})+\"'\n",
        Comment=f'# """ + {code} + """\nint32 d  # \'\'\' {code}\n',
        Lines=f"string E='a\\n{quoted}'\n",
        Braces=f"string F='@(({quoted}))'\n",
    )
    assert len(learnt.added) + len(learnt.refused) == 6
    assert learnt.added
    package = import_module("own_msgs.msg")
    for name in learnt.added:
        with suppress(SyntaxError):  # a class that cannot be read is no way in either
            getattr(package, name.word)()
    assert not mark.exists()


def test_an_origin_is_kept_unknown_without_the_list_and_refused_if_damaged(
    empty: DefinitionStore,
) -> None:
    name = Name("own_msgs", "msg", "A")
    taught(empty, A="bool a")
    known = empty.origin(name)
    assert (known.source, known.type_hash[:7]) == ("a test", "RIHS01_")
    assert empty.origins() == {str(name): known}
    (path,) = empty.prefix.glob("origins.json")
    path.unlink()
    assert empty.origin(name).type_hash == ""
    assert empty.origins() == {}
    for text in ("", "[]", '{"own_msgs/msg/A": ["a"]}', '{"own_msgs/msg/A": [1, 2]}'):
        path.write_text(text)
        with pytest.raises(ConfigurationError) as caught:
            empty.origin(name)
        assert "Remove it" in caught.value.hint
        assert empty.text(name) == "bool a"


def test_the_command_learns_lists_shows_and_forgets(user: Path, tmp_path: Path) -> None:
    folder = write_package(tmp_path, "weld_msgs", WELD)
    environment = {**os.environ, "XDG_DATA_HOME": str(tmp_path / "data"), PREFIXES: sys.prefix}

    def ros(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "roboneuron.cli.main", "ros", *words]
        return subprocess.run(
            command, capture_output=True, text=True, env=environment, timeout=60, check=False
        )

    learnt = ros("learn", str(folder))
    assert learnt.returncode == 0, learnt.stderr
    assert learnt.stdout.endswith("5 learnt, 0 known, 0 refused.\n")
    listed = json.loads(ros("list", "--json").stdout)
    assert listed["weld_msgs/msg/Seam"]["source"] == str(folder / "msg" / "Seam.msg")
    assert 'string<=16 tool "tig"' in ros("show", "weld_msgs/msg/Seam").stdout
    assert ros("show", "weld_msgs/msg/None").returncode == 2
    assert ros("forget", "weld_msgs").stdout.startswith("5 interfaces")
    assert ros("learn", str(tmp_path / "nowhere")).returncode == 2


def test_damaged_descriptions_are_passed_over(tmp_path: Path) -> None:
    strike = Name("weld_msgs", "srv", "Strike")
    for number, text in enumerate(("", "[]", "{}", '{"type_hashes": [1]}', "\udcff")):
        path = tmp_path / str(number) / "share" / "weld_msgs" / "srv" / "Strike.json"
        path.parent.mkdir(parents=True)
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
    prefixes = sorted(tmp_path.iterdir())
    assert len(prefixes) == 5
    assert definition_of(strike, {f"{strike}_Request": "RIHS01_00"}, prefixes) == {}


def test_prefixes_are_those_of_processes(tmp_path: Path) -> None:
    for number, variables in (("1", b"A=1\0AMENT_PREFIX_PATH=/a:/b\0"), ("2", b""), ("x", b"")):
        (tmp_path / number).mkdir()
        (tmp_path / number / "environ").write_bytes(variables)
    (tmp_path / "3").mkdir()
    assert prefixes_of_processes(tmp_path) == [Path("/a"), Path("/b")]
