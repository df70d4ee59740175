"""Engines that serve LeRobot checkpoints bare over openpi's websocket: address and names of their
requests. State and rows are in the network's units, which the client converts.

Sources (public definitions, read 2026-11): SGLang
multimodal_gen/runtime/entrypoints/action/{openpi,api,protocol,ws_utils}.py and its cookbook page of
pi0.5; vLLM-Omni vllm_omni/entrypoints/openpi, docs/serving/openpi_api.md, deploy/pi0.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from urllib.parse import urlsplit

from rn_backend_openpi.conventions import NetworkUnits
from rn_backend_openpi.layout import Layout
from rn_backend_openpi.options import NormalisationOptions, PolicyOptions
from rn_vla.normalisation import Scaling, read_openpi_scalings
from roboneuron import ConfigurationError

IMAGES = "observation.images."
"""Prefix of a camera's name in the key of its image."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ForeignEngine:
    """One engine.

    Attributes:
        path: of its websocket; added to a URL without one.
        state_key: key of the whole state.
    """

    path: str
    state_key: str


ENGINES: Mapping[str, ForeignEngine] = MappingProxyType(
    {
        "sglang": ForeignEngine(path="/openpi/policy", state_key="observation.state"),
        "vllm-omni": ForeignEngine(path="/v1/realtime/robot/openpi", state_key="state"),
    }
)
_BASE = MappingProxyType(
    {"primary": "base_0_rgb", "wrist": "left_wrist_0_rgb", "right_wrist": "right_wrist_0_rgb"}
)
"""Cameras of the base models of pi0 and pi0.5, and of most checkpoints made from them."""
_LIBERO = MappingProxyType({"primary": "image", "wrist": "image2"})
"""Cameras of LeRobot's checkpoints for LIBERO."""


def url_of(options: PolicyOptions) -> str:
    """The URL of a server elsewhere: with the path of the engine if it has none, or with the model
    at an address.
    """
    if options.address is not None:
        scheme = "ws" if options.ca_file is None else "wss"
        return f"{scheme}://{options.address}/{options.model or ''}"
    assert options.url is not None
    if options.engine is None or urlsplit(options.url).path.strip("/"):
        return options.url
    return options.url.rstrip("/") + ENGINES[options.engine].path


def for_engine(layout: Layout, options: PolicyOptions) -> Layout:
    """The layout with the engine's names and the conversion to its units; unchanged without an
    engine, and for DreamZero, which takes RoboArena's own.

    Raises:
        CheckpointError: the file with the statistics cannot be read.
        ConfigurationError: the statistics are of fewer values than the profile's.
    """
    if options.engine is None or not options.is_bare:
        return layout
    cameras = _LIBERO if layout.name == "libero" else _BASE
    keys = {role: IMAGES + cameras[role] for role in layout.image_keys if role in cameras}
    state = actions = None
    if isinstance(options.normalisation, NormalisationOptions):
        given = options.normalisation
        state, actions = read_openpi_scalings(given.file, given.kind)
        _check_width(actions, layout.rows.width, f"{given.file} (actions)")
    network = NetworkUnits(
        state_key=ENGINES[options.engine].state_key, state=state, actions=actions
    )
    return replace(layout, image_keys=options.image_keys or keys, network=network)


def _check_width(scaling: Scaling, width: int, what: str) -> None:
    if scaling.width < width:
        raise ConfigurationError(
            f"{what} has statistics of {scaling.width} values, the profile has {width}.",
            hint="Name the statistics of the served checkpoint.",
        )
