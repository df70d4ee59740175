"""A bad message, topic, file or bag is named and left out, and the rest is imported."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_expectations import mapping_of
from lab_bags import (
    JOINTS,
    STORE,
    Event,
    command_message,
    joint_state,
    joints,
    lab_events,
    make,
    mapping_text,
    raw_image,
    write_bag,
)
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionMode

from rn_recorder_bags.bag_files import find_bag
from rn_recorder_bags.importing import import_bags
from rn_recorder_bags.sampling import SampledEpisode, sample
from rn_recorder_bags.scanning import scan
from roboneuron import InvalidInputError

Change = Callable[[Any], Any]


def changed(
    events: list[Event], topic: str, change: Change, place: int | None = None
) -> list[Event]:
    """The events with one of a topic, or all, changed."""
    found = []
    count = 0
    for event in events:
        if event.topic == topic:
            is_meant = place is None or count == place
            event = replace(event, message=change(event.message)) if is_meant else event
            count += 1
        found.append(event)
    return found


def sampled(
    path: Path, commands: Any = "next_state", extra: str = ""
) -> tuple[list[SampledEpisode], list[str]]:
    """Episodes of a bag, and all that is told."""
    mapping = mapping_of(path.parent, extra + mapping_text(commands))
    found = scan(find_bag(path), mapping)
    episodes, gaps = sample(found, mapping)
    return episodes, [*found.left_out, *gaps]


def cut_data(message: Any) -> Any:
    return replace(message, data=message.data[:60])


NAN, HUGE, ZEROS = [0, np.nan, 0], [1e39, 0, 0], [0, 0, 0]
STATE, COMMAND, CAMERA = "/lab/joints", "/lab/command", "/lab/cam"
MESSAGES: dict[str, tuple[str, str, Change, str]] = {
    "not a number": (STATE, "png", lambda m: joint_state(JOINTS, NAN, 1), "a2 is not finite"),
    "too large": (STATE, "png", lambda m: joint_state(JOINTS, HUGE, 1), "a1 is not finite"),
    "names and values": (STATE, "png", lambda m: joint_state(JOINTS[:2], ZEROS, 1), "2 names"),
    "cut CDR": (STATE, "png", lambda m: (m.__msgtype__, b"\0\1\0\0\5"), "cannot be decoded"),
    "trajectory": (COMMAND, "png", lambda m: replace(m, joint_names=["a1"]), "1 joints and 3"),
    "no points": (COMMAND, "png", lambda m: replace(m, points=[]), "no points"),
    "cut JPEG": (CAMERA, "jpeg", cut_data, "no whole JPEG"),
    "cut PNG": (CAMERA, "png", cut_data, "no whole JPEG"),
    "depth": (CAMERA, "png", lambda m: replace(m, format="compressedDepth"), "is depth"),
    "cut image": (CAMERA, "raw", cut_data, "60 bytes"),
    "cut CDR of a video": (CAMERA, "h264", lambda m: (m.__msgtype__, b"\0\1\0\0\5"), "decoded"),
    "cut video": (CAMERA, "h264", cut_data, "video frame"),
    "empty video": (CAMERA, "h264", lambda m: replace(m, data=m.data[:0]), "is empty"),
    "format of a video": (CAMERA, "h264", lambda m: replace(m, format="vp9"), "'vp9'"),
}


@pytest.mark.parametrize("case", MESSAGES)
def test_a_bad_message_is_named_and_left_out(tmp_path: Path, case: str) -> None:
    topic, images, change, word = MESSAGES[case]
    commands = "trajectory" if topic == COMMAND else "next_state"
    place = 11 if topic == CAMERA else 40
    events = lab_events(images, commands)
    bad = changed(events, topic, change, place)
    episodes, told = sampled(write_bag(tmp_path / "bad", "mcap", bad), commands)
    (named,) = [one for one in told if "left out" in one]
    # what follows a video frame needs it, up to the next key frame
    count = 4 if images == "h264" else 1
    assert named.startswith(f"{count} messages of {topic} are left out")
    assert word in named
    gone = [place, place + 1, place + 2, place + 3][:count]
    of_topic = [event for event in events if event.topic == topic]
    without = [event for event in events if event not in [of_topic[index] for index in gone]]
    if images == "h264":
        without = lab_events("png", commands, lost=gone)
    wanted, _ = sampled(write_bag(tmp_path / "without", "sqlite3", without), commands)
    assert [one.rows for one in episodes] == [one.rows for one in wanted]
    for episode, other in zip(episodes, wanted, strict=True):
        np.testing.assert_array_equal(episode.state, other.state)
        np.testing.assert_array_equal(episode.action, other.action)


@pytest.mark.parametrize("form", ["h264", "h265"])
def test_frames_of_a_video_that_need_a_lost_one_are_left_out(tmp_path: Path, form: Any) -> None:
    """A recorder that loses a message must not give other pictures than the camera's."""
    events = lab_events(form, "next_state", lost=[11])
    path = write_bag(tmp_path / "bag", "mcap", events)
    episodes, told = sampled(path)
    (named,) = [one for one in told if "left out" in one]
    assert named.startswith("3 messages of /lab/cam are left out")
    assert "missing" in named
    wanted, _ = sampled(
        write_bag(tmp_path / "png", "mcap", lab_events("png", "next_state", lost=range(11, 15)))
    )
    assert [one.rows for one in episodes] == [one.rows for one in wanted]


TOPICS: dict[str, tuple[str, Change, str, bool]] = {
    "no camera": (CAMERA, lambda m: None, "has no picture", True),
    "depth": (CAMERA, lambda m: replace(m, format="compressedDepth"), "is depth", True),
    "no images": (CAMERA, lambda m: make("std_msgs/Bool", data=True), "no image", True),
    "no joints": (STATE, lambda m: None, "never gives a2 (elbow)", False),
    "other joints": (STATE, lambda m: joint_state("xyz", ZEROS, 1), "never gives", False),
    "bad joints": (STATE, lambda m: joint_state("xyz", [0], 1), "3 names", False),
    "no commands": (COMMAND, lambda m: None, "/lab/command never gives a2", False),
}


@pytest.mark.parametrize("case", TOPICS)
def test_a_bad_topic_is_named(tmp_path: Path, case: str) -> None:
    """Without a camera the rest is imported; without a number the other bags are."""
    topic, change, word, is_imported = TOPICS[case]
    events = [one for one in changed(lab_events(), topic, change, None) if one.message is not None]
    bad = write_bag(tmp_path / "bad", "mcap", events)
    if is_imported:
        episodes, told = sampled(bad, "trajectory")
        assert episodes[0].pictures == {}
        assert any(word in one for one in told)
        return
    good = write_bag(tmp_path / "good", "mcap", lab_events())
    mapping = mapping_of(tmp_path, mapping_text())
    written = import_bags([bad, good], mapping, tmp_path / "set", codec="h264")
    assert written.episodes == 4
    (named,) = [one for one in written.skipped if one.run == "bad"]
    assert word in named.why
    with pytest.raises(InvalidInputError, match="No episode") as refusal:
        import_bags([bad], mapping, tmp_path / "other", codec="h264")
    assert word in refusal.value.hint
    assert not (tmp_path / "other").exists()


def test_most_episodes_decide_which_cameras_are_written(tmp_path: Path) -> None:
    events = lab_events("raw", "next_state")
    small = changed(events, "/lab/cam", lambda m: raw_image(np.zeros((8, 8, 3), np.uint8), 1), None)
    bags = [
        write_bag(tmp_path / name, "mcap", one)
        for name, one in (("one", events), ("small", small), ("two", events))
    ]
    mapping = mapping_of(tmp_path, mapping_text("next_state"))
    written = import_bags(bags, mapping, tmp_path / "set", codec="h264")
    others = [one for one in written.skipped if "most have" in one.why]
    assert {one.run for one in others} == {"small"}
    assert written.episodes == 2 * len(others)


def cut_file(folder: Path) -> None:
    (path,) = [one for one in folder.iterdir() if one.suffix in (".mcap", ".db3")]
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


FILES: dict[str, tuple[Callable[[Path], None], str]] = {
    "cut": (cut_file, "is read up to its damage"),
    "no file": (lambda folder: [one.unlink() for one in folder.glob("bag.*")], "No such file"),
    "no YAML": (lambda folder: (folder / "metadata.yaml").write_text("{"), "metadata.yaml cannot"),
    "no table": (lambda folder: (folder / "metadata.yaml").write_text("a: 1"), "is missing"),
    "empty": (lambda folder: [one.unlink() for one in folder.iterdir()], "is no bag"),
}


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("case", FILES)
def test_a_damaged_bag_is_named(tmp_path: Path, case: str, storage: str) -> None:
    damage, word = FILES[case]
    path = write_bag(tmp_path / "bag", storage, lab_events("raw", "next_state"))
    damage(path)
    try:
        told = sampled(path)[1]
    except InvalidInputError as error:
        told = [str(error)]
    assert any(word in one for one in told)


def old_bag(path: Path) -> None:
    """As before ROS 2 Iron: without definitions."""
    with sqlite3.connect(path / "bag.db3") as base:
        base.executescript("DROP TABLE message_definitions; DROP TABLE schema; DROP TABLE metadata")


def idl_bag(path: Path) -> Path:
    """One type that was defined in IDL, with another one."""
    rule = "=" * 80 + "\n"
    jaw = (
        "module lab_msgs {\n module msg {\n struct Jaw { float force; double opening; };\n };\n};\n"
    )
    grip = (
        '#include "lab_msgs/msg/Jaw.idl"\n#include "std_msgs/msg/Header.idl"\nmodule lab_msgs {\n'
        " module msg {\n typedef lab_msgs::msg::Jaw lab_msgs__msg__Jaw__2[2];\n struct Grip {\n"
        " std_msgs::msg::Header header;\n lab_msgs__msg__Jaw__2 jaws;\n };\n };\n};\n"
    )
    header = (
        "module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; "
        "string frame_id; }; }; };"
    )
    time = (
        "module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };"
    )
    parts = {
        "lab_msgs/msg/Grip": grip,
        "lab_msgs/msg/Jaw": jaw,
        "std_msgs/msg/Header": header,
        "builtin_interfaces/msg/Time": time,
    }
    text = "".join(f"{rule}IDL: {name}\n{part}\n" for name, part in parts.items())
    path.mkdir()
    with (path / "a.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2", library="another")
        schema = writer.register_schema("lab_msgs/msg/Grip", "ros2idl", text.encode())
        channel = writer.register_channel("/lab/joints", "cdr", schema)
        for number in range(20):
            at_ns = 10**18 + number * 50_000_000
            message = command_message("own type", number, at_ns)
            data = bytes(STORE.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channel, at_ns, data, at_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def test_types_are_learnt_from_idl(tmp_path: Path) -> None:
    text = (
        "fps = 20\naction = 'next_state'\n[[state]]\ntopic = '/lab/joints'\n"
        "values = { 'jaws[1].opening' = 'right' }\n"
    )
    mapping = mapping_of(tmp_path, text)
    found = scan(find_bag(idl_bag(tmp_path / "bag")), mapping)
    (episode,), told = sample(found, mapping)
    assert told == []
    np.testing.assert_array_equal(episode.state[:, 0], [-number / 13 for number in range(19)])


FORMS: dict[str, tuple[str, Any, Callable[[Path], Path]]] = {
    "folder without metadata": ("mcap", None, lambda p: (p / "metadata.yaml").unlink() or p),
    "MCAP file": ("mcap", None, lambda p: p / "bag.mcap"),
    "SQLite file": ("sqlite3", None, lambda p: p / "bag.db3"),
    "SQLite without definitions": ("sqlite3", None, lambda p: old_bag(p) or p),
    "compressed file": ("sqlite3", CompressionMode.FILE, lambda p: p),
    "compressed file alone": ("sqlite3", CompressionMode.FILE, lambda p: p / "bag.db3.zstd"),
    "compressed messages": ("sqlite3", CompressionMode.MESSAGE, lambda p: p),
    "compressed messages in MCAP": ("mcap", CompressionMode.MESSAGE, lambda p: p),
    "compressed chunks": ("mcap", CompressionMode.STORAGE, lambda p: p),
}


@pytest.mark.parametrize("form", FORMS)
def test_each_form_of_a_bag_is_read(tmp_path: Path, form: str) -> None:
    storage, compression, change = FORMS[form]
    events = lab_events("jpeg", "next_state")
    plain, told = sampled(write_bag(tmp_path / "plain", "mcap", events))
    path = change(write_bag(tmp_path / "bag", storage, events, compression))
    episodes, also_told = sampled(path)
    assert also_told == told
    for episode, other in zip(episodes, plain, strict=True):
        np.testing.assert_array_equal(episode.state, other.state)


def test_a_type_without_a_definition_is_named(tmp_path: Path) -> None:
    events = lab_events("h264", "next_state")
    path = write_bag(tmp_path / "bag", "sqlite3", events)
    old_bag(path)
    _, told = sampled(path)
    assert any("No definition of foxglove_msgs/msg/CompressedVideo" in one for one in told)


def test_samples_of_several_files_are_one_recording(tmp_path: Path) -> None:
    events = lab_events("raw", "next_state")
    whole, _ = sampled(write_bag(tmp_path / "whole", "mcap", events))
    for number, part in enumerate((events[:90], events[90:])):
        write_bag(tmp_path / f"part_{number}", "mcap", part)
    split = tmp_path / "split"
    split.mkdir()
    for number, name in enumerate(("split_2.mcap", "split_10.mcap")):
        (tmp_path / f"part_{number}" / f"part_{number}.mcap").rename(split / name)
    episodes, _ = sampled(split)
    assert [one.rows for one in episodes] == [one.rows for one in whole]
    assert joints(0)[1] == episodes[0].state[0, 0]
