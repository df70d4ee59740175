"""Names of the core that features may use in a module's process, by defining module; `node.py`
reads this file at run time.
"""

# ruff: noqa: I001
from collections.abc import Mapping

# Modules, of which the names in `GROUPS` may be used.
from .config import (
    models as models,
)
from .gate.motion import (
    task_space as task_space,
)
from .modules import (
    settings as settings,
)
from .plugins import (
    loading as loading,
)
from .ros import (
    messages as messages,
    qos as qos,
    topics as topics,
)

# Single names.
from .gate.motion.command import (
    Asked as Asked,
)
from .gate.motion import (
    LimitedCommand as LimitedCommand,
)
from .modules.holding import (
    HoldingModule as HoldingModule,
)
from .modules.module_host import (
    Handover as Handover,
    Module as Module,
    ModuleHost as ModuleHost,
)
from .modules.plugin import (
    build as build,
    load_profile as load_profile,
)
from .modules.status import (
    StatusWriter as StatusWriter,
)
from .modules.worker import (
    Worker as Worker,
)
from .planning import (
    find_robot as find_robot,
)
from .ros.host import (
    NodeTopics as NodeTopics,
)

__all__: list[str]
GROUPS: Mapping[str, frozenset[str]]
