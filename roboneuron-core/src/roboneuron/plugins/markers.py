"""The pluggy markers of the project: plugins decorate their hook functions with `hookimpl`."""

import pluggy

PROJECT = "roboneuron"
"""Name of the pluggy project and of the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)
