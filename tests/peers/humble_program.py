"""A stand-in for a process of ROS 2 Humble: an endpoint without type hash, and Humble's discovery
message, whose GIDs have 24 bytes instead of 16.

    python humble_program.py DOMAIN

For each number on its standard input it sends this many discovery messages, each with other nodes,
and reports when all are acknowledged.
"""

import sys
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, sequence, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from cyclonedds.util import duration

PAUSE_S = 120.0
RELIABLE = Policy.Reliability.Reliable(duration(seconds=PAUSE_S))


@dataclass
@final
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    """std_msgs/String."""

    data: str


@dataclass
@final
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """rmw_dds_common/Gid until Humble."""

    data: array[uint8, 24]


@dataclass
@final
class NodeEntities(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """rmw_dds_common/NodeEntitiesInfo."""

    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
@final
class Participant(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """rmw_dds_common/ParticipantEntitiesInfo."""

    gid: Gid
    node_entities_info_seq: sequence[NodeEntities]


def gid(guid: bytes) -> Gid:
    """16 bytes of a GUID, padded with zeros as in Humble."""
    return Gid([*guid, *bytes(24 - len(guid))])


def told(guid: bytes, number: int) -> Participant:
    """Discovery message of a process with a node, each time with another node and other
    endpoints.
    """
    ends = [gid(guid[:12] + (number * 8 + end).to_bytes(4, "big")) for end in range(8)]
    node = NodeEntities("/fr3", f"old_{number:06d}", ends[:4], ends[4:])
    return Participant(gid(guid), [node] * (1 + number % 5))


def main() -> None:
    """Send the requested numbers of messages."""
    participant = DomainParticipant(int(sys.argv[1]), qos=Qos(Policy.Userdata(b"enclave=/;")))
    latched = Qos(
        RELIABLE,
        Policy.History.KeepAll,
        Policy.Durability.TransientLocal,
        Policy.DurabilityService(
            cleanup_delay=0,
            history=Policy.History.KeepLast(1),
            max_samples=-1,
            max_instances=-1,
            max_samples_per_instance=-1,
        ),
    )
    old = DataWriter(participant, Topic(participant, "rt/fr3/old", String), latched)
    discovery = Topic(participant, "ros_discovery_info", Participant)
    telling = DataWriter(participant, discovery, latched)
    old.write(String("old"))
    guid = participant.guid.bytes
    sent = 0
    telling.write(told(guid, sent))
    print("there", flush=True)
    for line in sys.stdin:
        for _ in range(int(line)):
            sent += 1
            telling.write(told(guid, sent))
        readers = len(telling.get_matched_subscriptions())
        acknowledged = telling.wait_for_acks(duration(seconds=PAUSE_S))
        print(sent if readers and acknowledged else "not acknowledged", flush=True)


if __name__ == "__main__":
    main()
