"""Types of a graph that nobody knows here: found, and not imported."""

from __future__ import annotations

import sys

from rn_interfaces.graph import is_known, uses
from rn_interfaces.store import DefinitionStore


class Graph:
    """A graph with many unknown types, and an action."""

    def topics(self) -> dict[str, list[str]]:
        """Types by topic."""
        unknown = {f"/topic_{i}": [f"other_msgs/msg/Type{i}"] for i in range(1000)}
        return {**unknown, "/weld/_action/feedback": ["weld_msgs/action/Weld_FeedbackMessage"]}

    def services(self) -> dict[str, list[str]]:
        """Types by service."""
        return {
            "/strike": ["weld_msgs/srv/Strike"],
            "/weld/_action/send_goal": ["weld_msgs/action/Weld_SendGoal"],
        }


def test_a_thousand_unknown_types_are_found_and_not_imported(store: DefinitionStore) -> None:
    before = set(sys.modules)
    found = uses(Graph())
    known = {str(name): topics for name, topics in found.items() if is_known(store, name)}
    assert known == {"weld_msgs/action/Weld": ["/weld"], "weld_msgs/srv/Strike": ["/strike"]}
    assert len(found) == 1002
    assert set(sys.modules) == before
