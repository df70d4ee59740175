"""Recordings of other programs and damaged ones: named for what they are, beside whole ones."""

from __future__ import annotations

import struct
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.writer import Writer
from recorder_demonstrations import record_run, store_in

from rn_recorder_runs.command import Runs
from rn_recorder_runs.files import Record, copy_records, read_records
from rn_recorder_runs.reading import RecordDecoder, count_topics, iterate

Call = Callable[..., tuple[int, str, str]]
Channel = tuple[str, str, str, bytes, str, list[tuple[int, bytes]]]
"""Topic, type, schema encoding, schema, message encoding, messages with their log time."""
CDR = b"\0\1\0\0"
BYTE = CDR + b"\7"
WIDE = CDR + struct.pack("<i", -5)
OK: Channel = ("/ok", "a/msg/Ok", "ros2msg", b"uint8 a\n", "cdr", [(10, BYTE), (30, BYTE)])


@pytest.fixture
def runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Call:
    """Run the command; its status, stdout and stderr."""

    def call(*words: str) -> tuple[int, str, str]:
        parser = ArgumentParser()
        command = Runs()
        command.configure(parser)
        directory = str(store_in(tmp_path).directory)
        status = command.run(parser.parse_args(["--directory", directory, *words]))
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


def bag(path: Path, *channels: Channel) -> Path:
    """Write a recording of another program."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", library="another 1.2")
        for topic, name, encoding, schema, form, messages in channels:
            number = writer.register_schema(name, encoding, schema)
            channel = writer.register_channel(topic, form, number)
            for log_ns, data in messages:
                writer.add_message(channel, log_ns, data, log_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


OTHERS = {
    "ros1msg": "ros1",
    "protobuf": "protobuf",
    "jsonschema": "json",
    "ros2idl": "cdr",
    "omgidl": "cdr",
    "flatbuffer": "flatbuffer",
}


def test_a_bag_of_another_program_is_named_and_its_topics_too(runs: Call, tmp_path: Path) -> None:
    others: list[Channel] = [
        (f"/{encoding}", f"b.{encoding}", encoding, b"\xff\xfe\0", form, [(5, b"{}")])
        for encoding, form in OTHERS.items()
    ]
    path = bag(tmp_path / "foreign.mcap", OK, *others)
    status, out, err = runs("show", str(path))
    assert (status, err) == (0, "")
    assert "another 1.2" in out
    lines = {line.split()[0]: line for line in out.splitlines() if line.startswith("/")}
    assert not lines["/ok"].endswith("decoded")
    assert all(lines[f"/{encoding}"].endswith("not decoded") for encoding in OTHERS)
    status, out, err = runs("export", str(path), "--mcap", str(tmp_path / "copy.mcap"))
    assert status == 1
    assert out.endswith("2 messages\n")
    assert all(f"/{encoding} " in err for encoding in OTHERS)
    assert {record.topic for record in read_records(tmp_path / "copy.mcap")} == {"/ok"}


@pytest.mark.parametrize("name", ["Seam", "", "a.b.C", "a::msg::dds_::B_", "a/b/c/D"])
def test_odd_names_of_types_do_not_end_the_reading(name: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", OK, ("/odd", name, "ros2msg", b"int32 a\n", "cdr", [(1, WIDE)]))
    assert [one.message.a for one in iterate([path], lambda topic: topic == "/ok")] == [7, 7]
    assert count_topics([path])["/odd"].messages == 1


def test_each_definition_decodes_its_own_data_and_is_copied_with_it(tmp_path: Path) -> None:
    first = bag(
        tmp_path / "a.mcap",
        OK,
        ("/wide", "a/msg/Ok", "ros2msg", b"int32 a\n", "cdr", [(20, WIDE)]),
    )
    second = bag(tmp_path / "b.mcap", ("/ok", *OK[1:3], b"int32 a\n", "cdr", [(40, WIDE)]))
    copy_records([first, second], tmp_path / "both.mcap", {})
    for files in ([first, second], [tmp_path / "both.mcap"]):
        found = [(one.record.topic, one.message.a) for one in iterate(files, lambda _: True)]
        assert sorted(found) == [("/ok", -5), ("/ok", 7), ("/ok", 7), ("/wide", -5)]
    counts = count_topics([tmp_path / "both.mcap"])
    assert "2 definitions" in counts["/ok"].note
    assert "2 definitions" in counts["/wide"].note


def test_times_are_those_of_the_messages_and_not_of_their_order(tmp_path: Path) -> None:
    late: Channel = (*OK[:5], [(50, BYTE), (10, BYTE), (30, BYTE)])
    counts = count_topics([bag(tmp_path / "a.mcap", late)])["/ok"]
    assert (counts.first_ns, counts.last_ns) == (10, 50)


DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "text": lambda data: b"these are words, no recording\n",
    "magic only": lambda data: data[:8],
    "cut": lambda data: data[:-30],
    "cut in the middle": lambda data: data[: len(data) // 2],
    "changed": lambda data: data[:60] + bytes(len(data) - 100) + data[-40:],
    "long record": lambda data: data[:9] + b"\xff" * 7 + b"\x7f" + data[17:],
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_file_is_named_and_gives_1(case: str, runs: Call, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", OK)
    path.write_bytes(DAMAGED[case](path.read_bytes()))
    status, _, err = runs("show", str(path))
    assert status == 1
    assert str(path) in err
    assert "unpack" not in err
    assert runs("show", str(path), "--json")[0] == 1


def test_whole_runs_are_listed_and_exported_beside_damaged_ones(runs: Call, tmp_path: Path) -> None:
    store = store_in(tmp_path)
    record_run(store, "monday", [("pick it up", "success")])
    record_run(store, "tuesday", [("pick it up", "success")])
    (tuesday,) = [run for run in store.runs() if run.id == "tuesday"]
    tuesday.files[0].write_text("no recording")
    status, out, _ = runs("list")
    assert status == 0
    assert "monday" in out
    assert "tuesday" in out
    assert runs("show", "monday")[0] == 0
    assert runs("show", "tuesday")[0] == 1
    status, out, err = runs("export", "monday", "tuesday", "--mcap", str(tmp_path / "both.mcap"))
    assert status == 1
    assert "tuesday" in err
    assert list(read_records(tmp_path / "both.mcap"))


@pytest.mark.parametrize("data", [b"no recording", b"cut"])
def test_listing_leaves_files_of_others_as_they_are(
    data: bytes, runs: Call, tmp_path: Path
) -> None:
    store = store_in(tmp_path)
    record_run(store, "monday", [("pick it up", "success")])
    (path,) = store.get("monday").files
    whole = bag(tmp_path / "a.mcap", OK).read_bytes()
    path.write_bytes(whole[:-30] if data == b"cut" else data)
    before = path.read_bytes()
    assert runs("list")[0] == 0
    assert path.read_bytes() == before


def test_data_that_do_not_fit_their_definition_are_a_value_error() -> None:
    for data, text in ((CDR, "float64[9] a\n"), (BYTE, "Unknown a\n"), (BYTE, "%%%"), (b"", "")):
        with pytest.raises(ValueError, match="/ok"):
            RecordDecoder().decode(Record("/ok", "a/msg/Ok", 1, 1, 1, data, text))
