"""The feature: the chosen locator, built on first use, and the tools that show what it finds."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, cast

from roboneuron import foreign
from roboneuron.contract.locator import (
    MOST_LABEL,
    MOST_LABELS,
    CalibratedImage,
    LabelLocator,
    LocatedObject,
    Locator,
)
from roboneuron.errors import InvalidInputError, NotReadyError, RoboNeuronError
from roboneuron.modules.plugin import build
from roboneuron.modules.settings import ModuleKind
from roboneuron.plugins.specs import LocatorSpec
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.interception import EndedCall
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.server.tool import Tool
from roboneuron.sight.cell_view import CellViews
from roboneuron.sight.locator_process import LocatorProcess
from roboneuron.sight.marks import CellLook
from roboneuron.sight.memory import SightMemory
from roboneuron.sight.options import SightOptions
from roboneuron.tools.inspect.looking import hands_in, locate_tool, look_tool

log = logging.getLogger(__name__)
_MOST_CLIENTS = 16
_CLOSE_S = 1.0


class Sight(Feature[SightOptions]):
    """Looks at the cell with the configured locator, for its tools and for other features."""

    def __init__(self, options: SightOptions) -> None:
        super().__init__(options)
        # guards memory and looks; not held while a locator works, which may take seconds
        self._lock = threading.Lock()
        # a locator is no thread-safe object: it is loaded and asked by one call at a time
        self._locating = threading.Lock()
        self._changes = 0
        self._locator: Locator | None = None
        self._looks: OrderedDict[str, CellLook] = OrderedDict()
        self._labels: dict[str, tuple[str, ...]] = {}
        self._memory = SightMemory()
        self._views = CellViews()

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """look and locate."""
        self._host = host
        host.events.change.listen(self._on_change)
        host.events.call_ended.listen(self._on_call)
        return [
            look_tool(host, self.look, self._arm),
            locate_tool(self.look, self.last_look),
        ]

    def _locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str]
    ) -> tuple[LocatedObject, ...]:
        """What the locator finds, which is loaded on first use; one call at a time. Raises
        RoboNeuronError.
        """
        host = self._host
        spec = host.registry.get(LocatorSpec, self.options.locator)
        if spec.needs_depth and images and all(one.frame.depth_m is None for one in images):
            raise NotReadyError(
                f"The locator {spec.name!r} needs depth, and no picture has one.",
                hint="Let a camera measure it, see docs/sight.md, or choose another locator.",
            )
        with self._locating:
            if self._locator is None:
                options = host.config.options(spec.name)
                locator: Locator = (
                    LocatorProcess(spec, options)
                    if spec.own_process
                    else cast("Locator", build(spec, options))
                )
                locator.load()
                self._locator = locator
            if labels:
                return tuple(cast("LabelLocator", self._locator).locate(images, labels))
            return tuple(self._locator.locate(images))

    def look(self, who: str, newer_than_ns: int = 0, labels: Sequence[str] = ()) -> CellLook:
        """See `Looker`."""
        labels = self._labels_of(who, labels)
        with self._lock:
            changes = self._changes
        exposed = self._arm()
        profile = None if exposed is None else exposed.profile
        view = self._views.take(
            self._host, profile, table_m=self.options.table_m, newer_than_ns=newer_than_ns
        )
        hands = hands_in(self._host, exposed, view)
        found: tuple[LocatedObject, ...] = ()
        failure = ""
        try:
            found = self._locate(view.images, labels)
        except RoboNeuronError as error:
            failure = str(error)
        with self._lock:
            recalled = self._memory.recall(view, found, hands)
            if changes != self._changes:
                self._memory.clear()  # the view is from before the table was forgotten
            objects = sorted(recalled.objects, key=lambda one: tuple(one.position_m.tolist()))
            look = CellLook(
                view=view,
                objects=tuple(objects),
                failure=failure,
                hidden=recalled.hidden,
                held=recalled.held,
                hands=hands,
            )
            self._looks[who] = look
            self._looks.move_to_end(who)
            self._labels[who] = labels
            if len(self._looks) > _MOST_CLIENTS:
                self._labels.pop(self._looks.popitem(last=False)[0])
        return look

    def _labels_of(self, who: str, labels: Sequence[str]) -> tuple[str, ...]:
        """What a client looks for. Raises InvalidInputError."""
        if not labels:
            with self._lock:
                return self._labels.get(who, ())
        spec = self._host.registry.get(LocatorSpec, self.options.locator)
        if not spec.takes_labels:
            raise InvalidInputError(
                f"The locator {spec.name!r} takes no labels: it finds what it knows.",
                hint="Leave them out.",
                path="labels",
            )
        return tuple(foreign.printable(label, MOST_LABEL) for label in labels[:MOST_LABELS])

    def forget(self, one: LocatedObject) -> None:
        """Forget where an object was: it is moved now."""
        with self._lock:
            self._memory.forget(one)

    def _on_change(self, kind: ModuleKind) -> None:
        """Forget the pictures and poses of a module that was changed, and the table when the robot
        stops: a simulated one is reset.
        """
        self._views.renew()
        if kind == "robot" and self._host.modules.view("robot").phase != "running":
            self._forget_all()

    def _on_call(self, ended: EndedCall) -> None:
        """Forget the table after an instruction: a policy may have moved anything."""
        if ended.call.arguments.get("instruction"):
            self._forget_all()

    def _forget_all(self) -> None:
        with self._lock:
            self._changes += 1
            self._memory.clear()

    @property
    def table_m(self) -> float:
        """Height of the table in the base frame [m]."""
        return self.options.table_m

    def last_look(self, who: str) -> CellLook | None:
        """The last look of a client."""
        with self._lock:
            return self._looks.get(who)

    def _arm(self) -> ExposedEndpoint | None:
        """An endpoint of the present robot with its profile; None without one."""
        name = self._host.config.robot.name
        exposed = self._host.gate.exposed
        return next((one for one in exposed if one.profile is not None and one.robot == name), None)

    def close(self) -> None:
        """See Feature; a locator that does not return within `_CLOSE_S` ends with the process."""
        self._views.close()
        if not self._locating.acquire(timeout=_CLOSE_S):
            log.warning("The locator %s has not returned; it is left.", self.options.locator)
            return
        try:
            if self._locator is not None:
                self._locator.close()
            self._locator = None
        finally:
            self._locating.release()
