"""No reader of a file raises anything but a deliberate error, whatever the file contains; a damaged
state file falls to the safe side.

`python tools/parsers.py 100000` prints a table.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from rn_eval.ledger import read_plan
from rn_interfaces import described as descriptions
from rn_interfaces.description import TypeDescription
from rn_interfaces.store import DefinitionStore
from rn_link.machine import read_machine
from rn_recorder_runs.files import (
    Record,
    RunFile,
    is_finished,
    read_about,
    read_attachments,
    read_records,
    read_statistics,
)
from rn_recorder_runs.store import read_facts
from rn_standard.ops.incidents import Incidents
from rn_standard.ops.maintenance import FILE_NAME as MAINTENANCE
from rn_standard.ops.maintenance import MaintenanceFile
from rn_standard.tasks.history import TaskHistory
from rn_testing.bad_data import DAMAGES, ESCAPED, NOTHING, Parser, damage, tried
from rn_view.diagnostics.alarms import FILE_NAME as ALARMS
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.event_list import EventList, add_record
from roboneuron import ConfigurationError, ForeignDataError, RoboNeuronError, foreign
from roboneuron.direct_path.type_hashes import read_type_hashes
from roboneuron.estop.latch import EmergencyStopLatch
from roboneuron.estop.latch_file import ESTOP_FILE, read_cause
from roboneuron.estop.pin import FILE_NAME as PIN
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog
from roboneuron.tools.arm.tightening import FILE_NAME as TIGHTENED
from roboneuron.tools.arm.tightening import TighteningFile


def in_file(name: str, read: Callable[[Path], object]) -> Callable[[Path, bytes], object]:
    def parse(folder: Path, data: bytes) -> object:
        (folder / name).write_bytes(data)
        return read(folder)

    return parse


def of_json(take: Callable[[dict], object]) -> Callable[[Path, bytes], object]:
    return lambda folder, data: take(foreign.decode_json(data, "it"))


def maintenance(folder: Path) -> None:
    state = MaintenanceFile(folder).read()
    assert state is not None  # the file is there: out of service whatever it holds
    assert str(state)


def latch(folder: Path) -> None:
    assert read_cause(folder / ESTOP_FILE).latched


def pin(folder: Path) -> None:
    with closing(AuditLog.in_directory(folder)) as audit:
        ReleasePin(folder, clock_s=lambda: 0.0).check("", who="x", audit=audit)


def described(folder: Path) -> None:
    assert len(TypeDescription(descriptions.read_facts(folder / "A.json"), ()).addresses) == 3


def mcap() -> bytes:
    """A finished file with a message and an attachment."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.mcap")
        file = RunFile(path, {"a": "b"}, {"std_msgs/msg/String": "string data"})
        data = b"\0\1\0\0\2\0\0\0a\0"
        file.write(Record("/a", "std_msgs/msg/String", 1, 1, 1, data))
        file.attach("a.json", "application/json", b"{}", 1)
        file.finish()
        return path.read_bytes()


def recorded(read: Callable[[Path], object]) -> Parser:
    parse = in_file("a.mcap", lambda folder: read(folder / "a.mcap"))
    return Parser("*.mcap", parse, MCAP, NOTHING)


MCAP = mcap()
FIELD = {
    "name": "data",
    "type": {"type_id": 2, "capacity": 0, "string_capacity": 0, "nested_type_name": ""},
    "default_value": "",
}
TYPE = {"type_name": "a_msgs/msg/A", "fields": [FIELD]}
DESCRIPTION = {
    "type_description_msg": {"type_description": TYPE, "referenced_type_descriptions": [TYPE]},
    "type_hashes": [{"type_name": "a_msgs/msg/A", "hash_string": "RIHS01_" + "0a" * 32}],
}
PARSERS = {
    "type description": Parser(
        "share/*/*.json", in_file("A.json", described), DESCRIPTION, (ConfigurationError,)
    ),
    "type hashes": Parser(
        "share/*/*.json",
        in_file("A.json", lambda folder: descriptions.read_hashes(folder / "A.json")),
        DESCRIPTION,
        (ConfigurationError,),
    ),
    "type hashes, direct path": Parser(
        "share/*/*.json",
        in_file("A.json", lambda folder: read_type_hashes(folder / "A.json")),
        DESCRIPTION,
        (ConfigurationError,),
    ),
    "type hashes, generated": Parser(
        "rosidl",
        lambda folder, data: descriptions.described_hashes(data),
        DESCRIPTION,
        (ForeignDataError,),
    ),
    "origins": Parser(
        "origins.json",
        in_file("origins.json", lambda folder: DefinitionStore(folder).origins()),
        {"a_msgs/msg/A": ["/talker", "RIHS01_0a"]},
        (ConfigurationError,),
    ),
    "statistics": recorded(read_statistics),
    "attachments": recorded(read_attachments),
    "metadata": recorded(read_about),
    "records": recorded(lambda path: [*read_records(path)]),
    "finished": recorded(is_finished),
    "recording": Parser(
        "run.json",
        in_file("run.json", read_facts),
        {"name": "a", "state": "x"},
        (ForeignDataError,),
    ),
    "latch": Parser(
        ESTOP_FILE,
        in_file(ESTOP_FILE, latch),
        {"who": "a", "reason": "b", "time_ns": 5, "restored": 0},
        NOTHING,
    ),
    "pin": Parser(
        PIN,
        in_file(PIN, pin),
        {"salt": "00", "hash": "x", "failures": 9, "not_before_s": 100.0},
        (RoboNeuronError,),
    ),
    "maintenance": Parser(
        MAINTENANCE,
        in_file(MAINTENANCE, maintenance),
        {"who": "a", "reason": "b", "since_s": 5.5},
        NOTHING,
    ),
    "tightened limits": Parser(
        TIGHTENED,
        in_file(TIGHTENED, lambda folder: TighteningFile(folder / TIGHTENED).read()),
        {"tightened": {"max_speed_m_s": 0.1, "keep_out": []}, "who": "a", "at_ns": 5},
        (ConfigurationError,),
    ),
    "link": Parser(
        "link.json",
        in_file("link.json", read_machine),
        {"name": "a", "role": "hub", "peers": {"b": ["10.0.0.1", "certificate"]}},
        (ConfigurationError,),
    ),
    "alarms": Parser(
        ALARMS,
        in_file(ALARMS, lambda folder: AlarmBook(folder, AuditLog.in_directory(folder))),
        {
            "seen_ns": 5,
            "alarms": [
                {
                    "number": 1,
                    "source": "a",
                    "what": "b",
                    "cause": "c",
                    "advice": "d",
                    "first_s": 1.0,
                    "last_s": 2.0,
                }
            ],
        },
        NOTHING,
    ),
    "incidents": Parser(
        "incidents/*.json",
        in_file("1.json", lambda folder: Incidents(folder).listing(9)),
        {"what": "x"},
        NOTHING,
    ),
    "past tasks": Parser(
        "tasks.jsonl",
        in_file("tasks.jsonl", lambda folder: TaskHistory(folder).newest()),
        {"instruction": "x", "status": "done"},
        NOTHING,
    ),
    "audit": Parser(
        "audit.jsonl",
        of_json(lambda record: add_record(EventList(), foreign.table(record, "it"))),
        {"time_ns": 5, "verdict": "refused", "who": "x", "reason": "y"},
        (ForeignDataError,),
    ),
    "evaluation plan": Parser(
        "plan.json", in_file("plan.json", read_plan), {"suite": "x"}, (ConfigurationError,)
    ),
}


@pytest.mark.parametrize("name", PARSERS)
def test_nothing_but_a_deliberate_error_escapes(name: str, tmp_path: Path) -> None:
    found = tried(PARSERS[name], 300, tmp_path)
    assert not [text for text in found if text.startswith(ESCAPED)]
    assert sum(found.values()) == 300


@pytest.mark.slow
@pytest.mark.parametrize("name", PARSERS)
def test_nothing_escapes_of_many_inputs(name: str, tmp_path: Path) -> None:
    found = tried(PARSERS[name], 100_000, tmp_path, seed=7)
    assert not [text for text in found if text.startswith(ESCAPED)]


@pytest.mark.parametrize("name", sorted(PARSERS.keys() - {"pin", "evaluation plan"}))
def test_the_valid_document_is_taken(name: str, tmp_path: Path) -> None:
    """Otherwise the mutations would be far from what is parsed."""
    parser = PARSERS[name]
    data = parser.valid if isinstance(parser.valid, bytes) else json.dumps(parser.valid).encode()
    parser.parse(tmp_path, data)


SAFE = {
    ESTOP_FILE: "latched",
    PIN: "no release",
    MAINTENANCE: "out of service",
    TIGHTENED: "no start: the limits are not known",
    "link.json": "no start: the link is not known",
}
"""What a damaged file means."""


def meaning(name: str, folder: Path) -> str:
    """What a reader makes of the file."""
    if name == ESTOP_FILE:
        return "latched" if EmergencyStopLatch.in_directory(folder).is_latched() else "released"
    if name == MAINTENANCE:
        state = MaintenanceFile(folder).read()
        if state is None:
            return "in service"
        assert str(folder / name) in str(state)  # the person reads which file
        return "out of service"
    read = {
        PIN: lambda: pin(folder),
        TIGHTENED: lambda: TighteningFile(folder / TIGHTENED).read(),
        "link.json": lambda: read_machine(folder),
    }[name]
    with pytest.raises(RoboNeuronError) as refusal:
        read()
    assert str(folder / name) in refusal.value.message
    assert refusal.value.hint
    return SAFE[name]


@pytest.mark.parametrize("name", SAFE)
@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_state_file_means_the_safe_side(name: str, kind: str, tmp_path: Path) -> None:
    valid = next(parser.valid for parser in PARSERS.values() if parser.place == name)
    damage(tmp_path / name, kind, valid)
    assert meaning(name, tmp_path) == SAFE[name]
