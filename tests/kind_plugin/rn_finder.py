"""A plugin of a test: a further kind of modules, which counts images. Standard library only."""

from roboneuron import FeatureSpec, ModuleKindSpec, hookimpl

FEATURE = FeatureSpec(
    name="finder",
    summary="Counts the images of a camera.",
    target="roboneuron:Feature",
    config="rn_finder_options:FinderOptions",
    module="rn_finder_module:FinderModule",
    module_kind=ModuleKindSpec(
        title="Start the finder",
        start_text="Count the images of a camera.",
        proof="it has counted one",
        stop_text="Count no more.",
        inputs=("perception",),
    ),
)


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this plugin."""
    return (FEATURE,)
