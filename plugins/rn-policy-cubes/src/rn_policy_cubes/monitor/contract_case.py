"""What the contract rules show the monitor; it is rendered in the simulated cell."""

from __future__ import annotations

from rn_policy_cubes.monitor.assessment import observations
from rn_policy_cubes.monitor.episodes import SUCCESS, record_episode, seed_of
from rn_policy_cubes.plugin import MONITOR
from rn_standard.tasks.contract_cases import MonitorCase

_VIEWS = 6
"""Pictures of the end of an episode: more than a second."""


def case() -> MonitorCase:
    """The named cube held up, and another one."""
    held, wrong = (
        tuple(observations(record_episode(kind, seed_of(kind, 50_000))))
        for kind in (SUCCESS, "wrong_cube")
    )
    return MonitorCase(
        spec=MONITOR, before=held[0], achieved=held[-_VIEWS:], missed=wrong[-_VIEWS:]
    )
