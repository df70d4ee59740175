"""The presets; they implement `rn_vla.decoding.LlamaAcceleration`."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from rn_accel_fastv.config import FastVConfig, PresetConfig
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_vla.decoding import LlamaAcceleration
    from rn_vla.pruning import PrunableDecoder


class _Preset:
    def __init__(self, config: PresetConfig, share: float) -> None:
        self._config = config
        self._share = share

    def apply(self, decoder: PrunableDecoder) -> None:
        """Install the selection of visual tokens.

        Raises:
            ConfigurationError: the decoder has no such hook, or no layer k.
        """
        if not callable(getattr(decoder, "install_selection", None)):
            raise ConfigurationError(
                f"FastV cannot be installed into a {type(decoder).__name__}: it cannot drop "
                "visual tokens.",
                hint='Choose a runtime with the capability "visual-token-pruning", such as torch.',
            )
        from rn_accel_fastv.selection import AttendedTokens  # heavy: torch

        decoder.install_selection(AttendedTokens(self._config.k, self._share, self._config.query))


class FastV(_Preset):
    """Drops a configurable share."""

    def __init__(self, config: FastVConfig) -> None:
        super().__init__(config, config.r)


class _Named(_Preset):
    share: ClassVar[float]

    def __init__(self, config: PresetConfig | None = None) -> None:
        super().__init__(config or PresetConfig(), self.share)


class FastVP25(_Named):
    """Drops a quarter."""

    share: ClassVar[float] = 0.25


class FastVP50(_Named):
    """Drops half."""

    share: ClassVar[float] = 0.5


class FastVP75(_Named):
    """Drops three quarters."""

    share: ClassVar[float] = 0.75


if TYPE_CHECKING:
    _: type[LlamaAcceleration] = FastVP50
