"""Names of the core that only commands may use, by defining module; `command.py` reads this
file at run time.
"""

# ruff: noqa: I001
from collections.abc import Mapping

# Modules, of which the names in `GROUPS` may be used.
from .cli import (
    state_folder as state_folder,
    terminal as terminal,
)
from .plugins import (
    availability as availability,
    descriptor as descriptor,
)
from .ros import (
    environment as environment,
    messages as messages,
    qos as qos,
)

# Single names.
from .hang_watch import (
    HangWatch as HangWatch,
)
from .cli.listing import (
    CommandModule as CommandModule,
    all_commands as all_commands,
)
from .cli.main import (
    configure as configure,
)
from .config.reading import (
    feature_options as feature_options,
    load_config as load_config,
)
from .gate.motion.rules import (
    poses_of as poses_of,
)
from .modules.parent_watch import (
    Signals as Signals,
)
from .planning import (
    check_configuration as check_configuration,
)
from .plugins.discovery import (
    discover as discover,
)
from .plugins.registry import (
    Offer as Offer,
    PluginRecord as PluginRecord,
    Status as Status,
)
from .plugins.specs import (
    PLUGIN_KINDS as PLUGIN_KINDS,
)
from .ros.link import (
    RosLink as RosLink,
)
from .server.app import (
    make_served as make_served,
)
from .server.registry import (
    ERROR_META as ERROR_META,
)

__all__: list[str]
GROUPS: Mapping[str, frozenset[str]]
