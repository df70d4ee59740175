"""The feature as every server loads it; its work begins with `[robots.<name>]`, see
`rn_standard.fleet.fleet`.
"""

from __future__ import annotations

from roboneuron import Feature


class FleetFeature(Feature[None]):
    """Adds nothing to the server of one robot."""
