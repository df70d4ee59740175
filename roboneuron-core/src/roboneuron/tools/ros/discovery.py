"""Discovery of endpoints in the live ROS graph by the configured patterns."""

from __future__ import annotations

import fnmatch
import logging
import re
from collections.abc import Callable, Mapping, Sequence

from roboneuron.config.models import Config
from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.direct_path.exposed import check_reserved, check_stop
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.errors import RoboNeuronError
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.supervisor.changes import Periodic
from roboneuron.tools.ros.discovered_limits import limit
from roboneuron.tools.ros.graph import GraphNames
from roboneuron.tools.ros.naming import to_label
from roboneuron.tools.ros.options import DiscoverConfig

log = logging.getLogger(__name__)
Kinds = Mapping[str, Mapping[str, str]]
"""Type by absolute name, by kind."""
_MEASURED = re.compile(r"(^|/)(joint_states|ee_pose|tf|tf_static|clock|camera/[^/]+/image)$")
"""Readable, but never writable by a pattern: topics of the robot's measurements."""
_SILENT = re.compile(
    r"(^|/)_|^/(rosout|parameter_events|diagnostics)$|/emergency_stop$|/transition_event$"
)
"""Never exposed by a pattern: hidden names, topics of the graph itself, and those of the server."""
_PARAMETER_SERVICE = re.compile(
    r"/(set|get|list|describe)_parameters?(_types|_atomically)?$|/get_type_description$"
)


class LiveGraph:
    """Thread that checks the graph and reports matching endpoints whenever they change."""

    def __init__(
        self,
        discover: Sequence[DiscoverConfig],
        config: Config,
        graph: GraphNames,
        known: Callable[[], tuple[ExposedEndpoint, ...]],
        profile: Callable[[str], RobotProfile | None],
        on_discovered: Callable[[tuple[ExposedEndpoint, ...]], None],
    ) -> None:
        """Args:
        discover: the patterns.
        config: configuration with the robot.
        graph: the live graph.
        known: returns the endpoints exposed by name.
        profile: returns a robot's profile, None without a plugin.
        on_discovered: called with the present matches, on the checking thread.
        """
        self._known = known
        self._profile = profile
        self._config = config
        self._discover = tuple(discover)
        self._graph = graph
        self._on_discovered = on_discovered
        self._thread: Periodic | None = None
        self._seen: Kinds = {}
        self._refused: set[tuple[str, str]] = set()

    def start(self) -> None:
        """Start the thread if the configuration has a pattern; returns at once."""
        if self._discover and self._thread is None:
            period_s = min(entry.period_s for entry in self._discover)
            self._thread = Periodic("direct-graph", period_s, self._look)
            self._thread.start()

    def stop(self) -> None:
        """End the thread; idempotent."""
        if self._thread is not None:
            self._thread.close()

    def _look(self) -> None:
        try:
            live = self._graph.used()
        except RoboNeuronError as error:
            log.error("The ROS graph cannot be looked at: %s", error)
            return
        if live != self._seen:
            self._seen = live
            self._on_discovered(self._match(live))

    def _match(self, live: Kinds) -> tuple[ExposedEndpoint, ...]:
        found: dict[tuple[str, str], ExposedEndpoint] = {}
        for entry in self._discover:
            count = 0
            for kind in entry.kinds:
                for name, type_name in sorted(live[kind].items()):
                    if (kind, name) in found or count >= entry.most or not _fits(entry, kind, name):
                        continue
                    exposed = self._expose(entry, kind, name, type_name)
                    if exposed is not None:
                        found[kind, name] = exposed
                        count += 1
        return tuple(found.values())

    def _expose(
        self, entry: DiscoverConfig, kind: str, name: str, type_name: str
    ) -> ExposedEndpoint | None:
        robot = entry.robot or self._config.robot.name
        namespace = (
            self._config.namespace if robot == self._config.robot.name else robot.replace("-", "_")
        )
        label = to_label(name.removeprefix(f"/{namespace}/"))[:48].rstrip("_")
        endpoint = Endpoint(
            name=label,
            kind=kind,
            topic=name,
            type=type_name,
            summary="",
            rate_hz=entry.rate_hz or 0.0,
        )
        try:
            check_endpoint(endpoint)
            bare = ExposedEndpoint(
                robot=robot,
                namespace=namespace,
                label=label,
                endpoint=endpoint,
                profile=self._profile(robot),
            )
            known = self._known()
            check_reserved(
                bare,
                {
                    self._config.namespace: self._config.robot.name,
                    **{e.namespace: e.robot for e in known},
                },
            )
            exposed = limit(bare, entry, known)
            check_stop(exposed)
        except RoboNeuronError as error:
            if (kind, name) not in self._refused:
                self._refused.add((kind, name))
                log.warning("%s is not exposed (%s): %s", name, kind, error)
            return None
        return exposed


def _fits(entry: DiscoverConfig, kind: str, name: str) -> bool:
    if (
        not fnmatch.fnmatchcase(name, entry.pattern)
        or _SILENT.search(name)
        or _PARAMETER_SERVICE.search(name)
    ):
        return False
    return kind != "publish" or not _MEASURED.search(name)
