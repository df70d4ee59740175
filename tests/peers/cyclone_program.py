"""A program that only uses Cyclone DDS, with the conventions of rmw_cyclonedds: topics `rt/...`,
services with a client header before the request, type hashes in USER_DATA.

    python cyclone_program.py DOMAIN

It ends with its standard input.
"""

import sys
import threading
import zlib
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float64, int64, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
OTHER_HASH = f"typehash=RIHS01_{'5e' * 32};".encode()
"""Hash of a definition that nobody else has."""


@dataclass
@final
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """std_msgs/String."""

    data: str


@dataclass
@final
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    """std_msgs/MultiArrayDimension."""

    label: str
    size: uint32
    stride: uint32


@dataclass
@final
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    """std_msgs/MultiArrayLayout."""

    dim: sequence[Dimension]
    data_offset: uint32


@dataclass
@final
class Bytes(IdlStruct, typename="std_msgs::msg::dds_::UInt8MultiArray_"):
    """std_msgs/UInt8MultiArray."""

    layout: Layout
    data: sequence[uint8]


@dataclass
@final
class Seam(IdlStruct, typename="own_msgs::msg::dds_::Seam_"):
    """own_msgs/Seam."""

    offset: array[float64, 3]
    tool: str
    picture: sequence[uint8]


@dataclass
@final
class SwitchRequest(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Request_"):
    """std_srvs/SetBool's request after rmw_cyclonedds' header."""

    guid: uint64
    number: int64
    data: bool


@dataclass
@final
class SwitchResponse(IdlStruct, typename="std_srvs::srv::dds_::SetBool_Response_"):
    """Its response."""

    guid: uint64
    number: int64
    success: bool
    message: str


@dataclass
@final
class GoalRequest(IdlStruct, typename="test_msgs::action::dds_::Fibonacci_SendGoal_Request_"):
    """test_msgs/Fibonacci's goal."""

    guid: uint64
    number: int64
    goal_id: array[uint8, 16]
    order: int64


class Program:
    """Readers and writers of one participant; callbacks run in threads of Cyclone DDS."""

    def __init__(self, domain: int) -> None:
        self._participant = DomainParticipant(domain)
        self._kept: list[object] = []

    def writer(self, name: str, of: type, *policies: Policy) -> DataWriter:
        """Create a writer, reliable by default."""
        topic = Topic(self._participant, name, of)
        qos = Qos(Policy.History.KeepLast(10), *(policies or (RELIABLE,)))
        return DataWriter(self._participant, topic, qos)

    def reader(self, name: str, of: type, take: object, *more: Policy) -> None:
        """Create a reliable reader that calls `take` with each sample."""

        class Taking(Listener):
            def on_data_available(self, reader: DataReader) -> None:
                for sample in reader.take(10):
                    take(sample)

        topic = Topic(self._participant, name, of)
        qos = Qos(Policy.History.KeepLast(10), RELIABLE, *more)
        self._kept.append(DataReader(self._participant, topic, qos, listener=Taking()))


def serve(program: Program, last: dict[str, str]) -> None:
    """Record texts and megabytes in `last`, answer the switch service, and accept goals."""
    switched = program.writer("rr/fr3/switchReply", SwitchResponse)

    def measure(message: Bytes) -> None:
        data = bytes(message.data)
        last["measured"] = f"{len(data)} {zlib.crc32(data)}"

    def hear(message: String) -> None:
        last["heard"] = f"heard {message.data}"

    def switch(asked: SwitchRequest) -> None:
        switched.write(SwitchResponse(asked.guid, asked.number, asked.data, "switched"))

    program.reader("rt/fr3/say", String, hear)
    program.reader("rt/fr3/measure", Bytes, measure)
    program.reader("rq/fr3/switchRequest", SwitchRequest, switch)
    goals = "rq/fr3/count/_action/send_goalRequest"
    program.reader(goals, GoalRequest, lambda goal: None)


def main() -> None:
    """Serve until standard input ends."""
    program = Program(int(sys.argv[1]))
    last = {"heard": "", "measured": ""}
    serve(program, last)
    large = program.writer("rt/fr3/large", Bytes)
    repeated = {name: program.writer(f"rt/fr3/{name}", String) for name in last}
    blurred = program.writer("rt/fr3/blurred", String, Policy.Reliability.BestEffort)
    program.reader("rt/fr3/blurred", String, lambda message: None)
    exclusive = Policy.Ownership.Exclusive
    program.reader("rt/fr3/owned", String, lambda message: None, exclusive)
    program.reader("rt/fr3/seam", Seam, lambda seam: None, Policy.Userdata(OTHER_HASH))
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    megabyte = Bytes(Layout([], 0), list(bytes(range(256)) * 4096))
    print("there", flush=True)
    while not ended.wait(0.2):
        large.write(megabyte)
        for name, text in last.items():
            repeated[name].write(String(text))
        blurred.write(String("blurred"))


if __name__ == "__main__":
    main()
