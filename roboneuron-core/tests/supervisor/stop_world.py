"""A supervisor with scripted modules on a test clock; no process is started."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rn_testing.fakes import fake_plan
from roboneuron.config import Config, ModuleSettings
from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Supervisor

MakeConfig = Callable[..., Config]
NEVER = float("inf")


class Clock:
    """A clock that only modules advance."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s

    def strftime(self, form: str) -> str:
        return "now"


class Module:
    """A module process and its node.

    Attributes:
        deactivates_s: time until its node is deactivated; NEVER if it does not answer.
        leaves_s: time until it ends after SIGTERM.
    """

    def __init__(self, pid: int, world: World, name: str = "module") -> None:
        self.pid, self.name = pid, name
        self.deactivates_s, self.leaves_s = 0.0, 0.0
        self.exit_code: int | None = None
        self.ended_at = datetime.now(UTC)
        self.log_path = Path("module.log")
        self.refusal: Exception | None = None
        self.is_slow_to_die = False
        self._world = world
        self._end_s = NEVER

    def announce(self, digest: bytes) -> None: ...

    def beat(self) -> None:
        self._world.calls.append(("beat", self.pid))

    def is_frozen(self) -> bool:
        return False

    def show(self) -> None: ...

    def terminate(self) -> None:
        self._world.calls.append(("terminate", self.pid))
        self._end_s = self._world.clock.now_s + self.leaves_s

    def kill(self) -> None:
        self._world.calls.append(("kill", self.pid))
        self._end_s = self._world.clock.now_s + (6.0 if self.is_slow_to_die else 0.0)
        self.exit_code = None if self.is_slow_to_die else -9

    def leaves(self, timeout_s: float) -> bool:
        return self.wait(timeout_s)

    def wait(self, timeout_s: float) -> bool:
        clock = self._world.clock
        self._world.calls.append(("wait", self.pid, round(timeout_s, 6)))
        clock.now_s = max(clock.now_s, min(self._end_s, clock.now_s + timeout_s))
        if self._end_s <= clock.now_s and self.exit_code is None:
            self.exit_code = 0
        return self._end_s <= clock.now_s


class World:
    """A supervisor whose modules are scripted."""

    def __init__(self, state: Path, make_config: MakeConfig) -> None:
        self.clock = Clock()
        self.calls: list[tuple[Any, ...]] = []
        self.changed: list[str] = []
        self.nodes: list[tuple[Any, ...]] = []
        self.closed: list[str] = []
        self._make_config = make_config
        self._pids = iter(range(7, 99))
        world = self

        class Connection:
            def __init__(self, on_status: object, log_directory: object) -> None: ...

            def link(self) -> str:
                return "link"

            def close(self) -> None:
                world.closed.append("connection")

        self.supervisor = Supervisor(
            state,
            on_change=self.changed.append,
            connect=Connection,  # type: ignore[arg-type]
        )

    def client(
        self, link: str, changes: object, node: str, announce: object, check: Callable[[], None]
    ) -> World:
        module = announce.__self__  # type: ignore[attr-defined]
        self.nodes.append((link, changes, node, module.pid, check))
        return self

    def transition(self, name: str, timeout_s: float) -> bool | None:
        pid = self.nodes[-1][3]
        module = next(m for m in self.modules() if m.pid == pid)
        self.calls.append((name, pid, round(timeout_s, 6)))
        self.nodes[-1][4]()
        if module.refusal is not None:
            raise module.refusal
        self.clock.now_s += min(module.deactivates_s, timeout_s)
        return True if module.deactivates_s <= timeout_s else None

    def modules(self) -> list[Module]:
        slots = (slot for slots in self.supervisor.slots.values() for slot in slots)
        return [slot.process for slot in slots if slot.process is not None]  # type: ignore[misc]

    def running(
        self, kind: ModuleKind, *, stop_timeout_s: float = 3.0, slot: Slot | None = None
    ) -> Module:
        """A started module."""
        slot = slot or self.starting(kind, stop_timeout_s=stop_timeout_s)
        module = Module(next(self._pids), self, kind)
        slot.process = module  # type: ignore[assignment]
        slot.settle("running")
        return module

    def starting(self, kind: ModuleKind, *, stop_timeout_s: float = 3.0) -> Slot:
        slot = self.supervisor.slot(kind)
        settings = ModuleSettings(
            kind=kind,
            node_name=kind,
            config=self._make_config(stop_timeout_s=stop_timeout_s),
            state_directory="state",
        )
        plan = fake_plan(kind, settings.config)
        slot.begin_start(plan, settings)
        return slot

    def named(self, name: str) -> list[tuple[Any, ...]]:
        return [call for call in self.calls if call[0] == name]
