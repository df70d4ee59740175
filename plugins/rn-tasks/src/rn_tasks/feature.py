"""The feature: tools of tasks, events as resources, prompts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rn_tasks.lifecycle import list_models_tool, start_all_tool
from rn_tasks.options import TasksSections
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool


class TasksFeature(Feature[TasksSections]):
    """Adds start_all, list_models, run_task, move_to and events."""

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """See `Feature.tools`."""
        return [start_all_tool(host), list_models_tool(host)]
