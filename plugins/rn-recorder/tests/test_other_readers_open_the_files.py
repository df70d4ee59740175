"""Programs that know nothing of RoboNeuron read what was recorded: the rosbags library, and MCAP's
own reader.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from recorder_demonstrations import action, picture, record_run, store_in

from rn_recorder_runs.files import copy_records, read_about
from rn_recorder_runs.reading import iterate

Read = Callable[[Path], Iterator[tuple[str, int, Any]]]
ROWS = 6
PADDED = "/toy/joint_states"
"""The serializer of rclpy, which makes this test's messages, leaves bytes behind some; those on the
wire have none.
"""


def read_with_rosbags(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, time and message of everything, in the order of time."""
    highlevel = pytest.importorskip("rosbags.highlevel", reason="pip install rosbags")
    with highlevel.AnyReader([path]) as reader:
        wanted = [connection for connection in reader.connections if connection.topic != PADDED]
        for connection, at_ns, data in reader.messages(wanted):
            yield connection.topic, at_ns, reader.deserialize(data, connection.msgtype)


def read_with_mcap(path: Path) -> Iterator[tuple[str, int, Any]]:
    """As `read_with_rosbags`."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            if channel.topic != PADDED:
                yield channel.topic, message.log_time, decoded


@pytest.mark.parametrize("read", [read_with_rosbags, read_with_mcap])
@pytest.mark.parametrize("copied", [False, True], ids=["recording", "copy"])
def test_another_reader_finds_every_message_as_it_was_sent(
    tmp_path: Path, read: Read, copied: bool
) -> None:
    """Incidents, exports and repaired files are copies."""
    run = record_run(store_in(tmp_path), "monday", [("lift the cup", "success")], rows=ROWS)
    path = run.files[0]
    if copied:
        path = tmp_path / "copy.mcap"
        copy_records(list(run.files), path, read_about(run.files[0]))
    found = list(read(path))
    ours = [
        (entry.record.topic, entry.record.log_ns)
        for entry in iterate(run.files, lambda topic: topic != PADDED)
    ]
    assert sorted((topic, at_ns) for topic, at_ns, _ in found) == sorted(ours)
    actions = [np.array(message.data) for topic, _, message in found if topic == "/toy/action"]
    np.testing.assert_array_equal(actions, [action(number) for number in range(ROWS)])
    images = [message for topic, _, message in found if topic == "/toy/camera/front/image"]
    for number, image in enumerate(images):
        assert (image.width, image.height, image.encoding) == (64, 64, "rgb8")
        assert bytes(image.data) == picture("front", number).tobytes()
