"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="fastdds",
    summary="Repairs Fast DDS shared memory after a process was killed.",
    target="rn_standard.fastdds.feature:SharedMemoryRepair",
    on_join="rn_standard.fastdds.lost_ports:watch_ports",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)
