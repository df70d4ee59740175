"""Why the robot does not move is one ordered answer, whichever mechanisms forbid it, and refusals
say the same.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from rn_standard.http.feature import HttpFeature
from rn_standard.http.plugin import FEATURE as HTTP
from rn_standard.ops.maintenance import MaintenanceFeature, MaintenanceFile
from rn_standard.ops.plugin import MAINTENANCE, REAL_ROBOT
from rn_standard.tasks.feature import TasksFeature
from rn_standard.tasks.plugin import FEATURE as TASKS
from rn_standard.teleoperation.feature import Teleoperation
from rn_standard.teleoperation.plugin import FEATURE as TELEOPERATION
from rn_testing.fakes import fake_plan, fake_registry
from roboneuron import DriverSpec, Feature, RefusedError, RobotSpec
from roboneuron.config import ModuleSettings, parse_config
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.options import DirectPathOptions
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.gate import AuditRecord, StillReason
from roboneuron.modules.report import Report
from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.server.registry import ERROR_META
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.loop.status import status

PAGE = Path(__file__).parents[1] / "docs" / "safety-reference.md"
ROW = re.compile(r"^\| ([A-Z]+) \| (`[^|]*|the code[^|]*) \|", re.MULTILINE)
ARM = RobotSpec(
    name="arm",
    summary="An arm.",
    target="rn_testing.fakes.robot:gantry_profile",
    action_widths=(7,),
    drivers=(
        DriverSpec(name="real", summary="For tests.", target="rn_testing.fakes.robot:FakeDriver"),
    ),
)
CONFIG = """
[robot]
name = "arm"
driver = "real"
[control]
controller = "gantry"
[tasks]
approval = ["run_task"]
"""


class Caller:
    """CallContext of a client whose user agrees."""

    simulated = False

    def __init__(self, who: str = "agent", role: str = "admin") -> None:
        self.who, self.role = who, role

    async def run(self, work: Callable[[Stage], Any], **_: Any) -> Any:
        """See CallContext."""
        return work(lambda stage: None)

    async def ask(self, question: str, what: str = "") -> str | None:
        """See CallContext: this client cannot."""
        return None


class Process:
    """A module process in a chosen state."""

    pid, exit_code, log_path = 7, None, Path("module.log")

    def __init__(self, *, is_frozen: bool = False) -> None:
        self.is_frozen = lambda: is_frozen
        self.ended_at = self.started_at = datetime.fromtimestamp(1e9, UTC)

    def last_lines(self) -> tuple[str, ...]:
        return ("the end",)


class Cell:
    """A server whose modules all work, and in which any mechanism can forbid motion."""

    def __init__(self, application: Application) -> None:
        self.application = application
        self.host, self.loop = application.host, application.loop
        self.asker = Caller()
        self.undo = ExitStack()

    def works(
        self, kind: ModuleKind, *, process: Any = None, late_s: float = 0.0, **more: Any
    ) -> None:
        """Let a module run and report `more`."""
        slot = self.host.modules.slot(kind)
        slot.settle("stopped")
        settings = ModuleSettings(
            kind=kind, node_name=kind, config=self.loop.base, state_directory="state"
        )
        slot.begin_start(fake_plan(kind, self.loop.base), settings)
        slot.process = process or cast("Any", Process())
        slot.report = Report(
            **{"ready": True, "state": "active", **more}, received_s=time.monotonic() + 9 - late_s
        )
        slot.settle("running")

    def feature(self, name: str, kind: type[Any]) -> Any:
        return self.host.feature(name, kind)

    def __enter__(self) -> Cell:
        for kind in MODULE_KINDS:
            self.works(kind)
        return self

    def __exit__(self, *_: object) -> None:
        for kind in MODULE_KINDS:
            self.host.modules.slot(kind).settle("stopped")
        self.undo.close()
        stop = self.loop.emergency_stop.file
        if stop.is_latched():
            stop.reset(who="a person", role="admin", audit=self.host.audit)
        self.host.audit.write(AuditRecord(who="test", role="", tool="", verdict="allowed"))
        lease = self.feature("http", HttpFeature).lease
        for who in ("agent", "someone"):
            lease.release(who)
        self.loop.starts.withdraw(self.loop.starts.ticket)
        self.application.supervisor.needs_start = ""
        self.asker = Caller()


def out_of_service(cell: Cell) -> None:
    feature = cell.feature("maintenance", MaintenanceFeature)
    file = MaintenanceFile(cell.host.state_directory)
    file.begin("ann", "admin", "oiling", cell.host.audit)
    feature.look()
    cell.undo.callback(feature.look)
    cell.undo.callback(file.path.unlink)


def unwritable_audit(cell: Cell) -> None:
    audit, path = cell.host.audit, cell.host.audit.path
    kept = path.with_suffix(".kept")
    path.rename(kept)
    path.mkdir()
    with pytest.raises(RefusedError):
        audit.write(AuditRecord(who="test", role="", tool="", verdict="allowed"))
    path.rmdir()
    kept.rename(path)


def only_simulates(cell: Cell) -> None:
    feature = direct_path(cell.host)
    before, feature.options = feature.options, DirectPathOptions(simulate=True)
    cell.undo.callback(setattr, feature, "options", before)


def robot_stopped(cell: Cell) -> None:
    cell.host.modules.slot("robot").settle("stopped")


def robot_exited(cell: Cell) -> None:
    cell.host.modules.slot("robot").settle("exited")


def held_by_a_limit(cell: Cell) -> None:
    a_task(cell)
    note = "holding: The TCP would leave the workspace."
    cell.works("control", note=note, metrics={"hold_code": "workspace"})


def a_task(cell: Cell) -> None:
    arbiter = cell.feature("tasks", TasksFeature)._arbiter
    cell.undo.enter_context(arbiter.claim("'pick'", threading.Event()))


def a_policy(cell: Cell) -> None:
    cell.loop.starts.begin("pick the cube")


def a_call(cell: Cell) -> None:
    path = direct_path(cell.host)
    exposed = next(one for one in path.allow_list.exposed if one.moves)
    motion = cell.undo.enter_context(path.arbiter.claim(exposed, "move_joints", threading.Event()))
    assert motion.exposed is exposed


def a_lead(cell: Cell) -> None:
    patch = cell.undo.enter_context(pytest.MonkeyPatch.context())
    lead = SimpleNamespace(who="ann", source_name="pad")
    patch.setattr(Teleoperation, "lead", property(lambda feature: lead))


def another_operator(cell: Cell) -> None:
    lease = cell.feature("http", HttpFeature).lease
    lease.admit(cell.application.tools.get("start_robot"), Caller("someone"))


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """One mechanism.

    Attributes:
        set: lets it forbid motion.
        tells: the rules that it causes, with their ranks.
        uses: what it needs for itself: of two that need the same, one is tried at a time.
    """

    set: Callable[[Cell], object]
    tells: tuple[tuple[str, str], ...]
    uses: frozenset[str] = field(default_factory=frozenset)


def robot(rule: str, change: Callable[[Cell], object], *more: tuple[str, str]) -> Mechanism:
    return Mechanism(set=change, tells=(("MODULE", rule), *more), uses=frozenset({"robot"}))


MECHANISMS = {
    # first: only a robot that works is claimed
    "call": Mechanism(set=a_call, tells=(("CLAIM", "ownership"),), uses=frozenset({"arm"})),
    "maintenance": Mechanism(set=out_of_service, tells=(("SERVICE", "maintenance"),)),
    "emergency_stop": Mechanism(
        set=lambda cell: cell.loop.emergency_stop.file.press(who="ann", reason="a hand"),
        tells=(("STOP", "emergency_stop"), ("START", "new_start")),
        uses=frozenset({"start"}),
    ),
    "audit": Mechanism(set=unwritable_audit, tells=(("SERVER", "audit"),)),
    "simulate": Mechanism(set=only_simulates, tells=(("SERVER", "simulate"),)),
    "stopped": robot("stopped", robot_stopped, ("PERSON", "person")),
    "exited": robot("exited", robot_exited, ("PERSON", "person")),
    "frozen": robot("frozen", lambda cell: cell.works("robot", process=Process(is_frozen=True))),
    "silent": robot("silent", lambda cell: cell.works("robot", late_s=60.0)),
    "stuck": robot("stuck", lambda cell: cell.works("robot", loop_age_s=9.0)),
    "stalled": robot("stalled", lambda cell: cell.works("robot", work_age_s=9.0, work_limit_s=1)),
    "failing": robot("failing", lambda cell: cell.works("robot", error_code="refused", error="x")),
    "waiting": robot("waiting", lambda cell: cell.works("robot", ready=False, waiting_for="x")),
    "fault": robot("fault", lambda cell: cell.works("robot", detail={"fault": "reflex"})),
    "other module": Mechanism(
        set=lambda cell: cell.works("perception", loop_age_s=9.0), tells=(("MODULE", "stuck"),)
    ),
    "hold": Mechanism(
        set=held_by_a_limit,
        tells=(("HOLD", "workspace"), ("CLAIM", "ownership")),
        uses=frozenset({"task"}),
    ),
    "new_start": Mechanism(
        set=lambda cell: cell.loop.starts.note_stop("control was stopped"),
        tells=(("START", "new_start"),),
        uses=frozenset({"start"}),
    ),
    "task": Mechanism(set=a_task, tells=(("CLAIM", "ownership"),), uses=frozenset({"task"})),
    "policy": Mechanism(set=a_policy, tells=(("CLAIM", "ownership"),), uses=frozenset({"arm"})),
    "lead": Mechanism(set=a_lead, tells=(("CLAIM", "lead"),)),
    "operator": Mechanism(set=another_operator, tells=(("OPERATOR", "operator"),)),
    "role": Mechanism(
        set=lambda cell: setattr(cell.asker, "role", "viewer"),
        tells=(("ROLE", "role"),),
        uses=frozenset({"role"}),
    ),
    "approval": Mechanism(
        set=lambda cell: setattr(cell.asker, "role", "operator"),
        tells=(("PERSON", "person"),),
        uses=frozenset({"role"}),
    ),
}
STANDARD = (HTTP, MAINTENANCE, REAL_ROBOT, TASKS, TELEOPERATION)
ORDER = [
    "SERVICE",
    "STOP",
    "SERVER",
    "MODULE",
    "HOLD",
    "START",
    "CLAIM",
    "OPERATOR",
    "ROLE",
    "PERSON",
]
SETS = [(), *((one,) for one in MECHANISMS)] + [
    pair
    for pair in combinations(MECHANISMS, 2)
    if not MECHANISMS[pair[0]].uses & MECHANISMS[pair[1]].uses
]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    registry = fake_registry(
        ARM, DIRECT_PATH, HTTP, MAINTENANCE, REAL_ROBOT, SELECTION, TASKS, TELEOPERATION
    )
    application = Application(
        parse_config(CONFIG, registry=registry),
        plugins=lambda: registry,
        directory=tmp_path_factory.mktemp("state"),
        command=lambda python: pytest.fail("nothing may be spawned"),
    )
    with pytest.MonkeyPatch.context() as patched:
        # maintenance would latch the stop too, which is another mechanism here
        patched.setattr(application.loop.emergency_stop, "latch", lambda *_, **__: ([], 0.0))
        yield Cell(application)
    application.close()


@pytest.fixture
def cell(served: Cell) -> Iterator[Cell]:
    with served:
        yield served


@pytest.mark.parametrize("names", SETS, ids="+".join)
def test_the_answer_is_every_reason_in_order(cell: Cell, names: tuple[str, ...]) -> None:
    for name in names:
        MECHANISMS[name].set(cell)
    found = [(one.rank.upper(), one.rule) for one in cell.host.why_still(cell.asker)]
    expected = [told for name in names for told in MECHANISMS[name].tells]
    assert found == sorted(found, key=lambda one: ORDER.index(one[0]))
    assert sorted({*found}) == sorted({*expected})


@pytest.mark.parametrize("name", MECHANISMS)
def test_the_status_says_it_and_the_first_general_reason_is_in_its_summary(
    cell: Cell, name: str
) -> None:
    MECHANISMS[name].set(cell)
    reasons = cell.host.why_still(cell.asker)
    answer = status(cell.host, cell.asker)
    assert [told.rule for told in answer.why_still] == [reason.rule for reason in reasons]
    general = [reason for reason in reasons if reason.is_for_everyone]
    assert all(answer.summary.endswith(reason.message) for reason in general[:1])
    assert len({told.message for told in answer.why_still} & {answer.summary}) == 0


@pytest.mark.parametrize(
    ("name", "tool"),
    [
        ("maintenance", "start_robot"),
        ("operator", "start_robot"),
        ("role", "start_robot"),
        ("task", "set_instruction"),
        ("emergency_stop", "set_instruction"),
        ("stopped", "set_instruction"),
    ],
)
def test_a_refusal_is_one_of_the_reasons(cell: Cell, name: str, tool: str) -> None:
    MECHANISMS[name].set(cell)
    if name == "stopped":
        cell.host.modules.slot("inference").settle("stopped")
        cell.loop.starts.begin("pick the cube")
    reasons = cell.host.why_still(cell.asker)
    arguments = {"instruction": "go"} if tool == "set_instruction" else {}
    answer = anyio.run(cell.application.tools.call, tool, arguments, cell.asker)
    assert answer.is_error
    details = (answer.meta or {})[ERROR_META]
    told = [(reason.rule, reason.message.replace("Moving the robot", tool)) for reason in reasons]
    if name == "stopped":  # an error of another class has no rule
        assert details["message"] in [message for _, message in told]
    else:
        assert (details["rule"], details["message"]) in told


def test_a_feature_that_fails_hides_no_other_reason(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(feature: Feature[Any], asker: object) -> list[StillReason]:
        raise RuntimeError("broken")

    monkeypatch.setattr(Teleoperation, "still_reasons", fail)
    another_operator(cell)
    assert [one.rule for one in cell.host.why_still(cell.asker)] == ["operator"]


def test_the_page_lists_every_mechanism_in_order() -> None:
    rows = ROW.findall(PAGE.read_text(encoding="utf-8"))
    listed = [(rank, rule) for rank, text in rows for rule in re.findall(r"`(\w+)`", text)]
    told = {one for mechanism in MECHANISMS.values() for one in mechanism.tells}
    # a module is seen in either phase only for a moment
    assert {*listed} == told | {("MODULE", "starting"), ("MODULE", "stopping")}
    assert list(dict.fromkeys(rank for rank, _ in rows)) == ORDER
