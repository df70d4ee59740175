"""Check of a server's model and release, before the first request and after every reconnection."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath

from rn_runtime_sglang.connection import HttpConnection
from rn_runtime_sglang.served.fingerprint import served_name
from rn_runtime_sglang.served.versions import SUPPORTED, is_supported
from rn_runtime_sglang.wire import error_text, parse_object
from roboneuron import CheckpointError, ConfigurationError, MissingDependencyError, NotReadyError

ARCHITECTURE = "OpenVLAForActionPrediction"


@dataclass(frozen=True, kw_only=True, slots=True)
class Expectation:
    """Expected identity of a server's model.

    Attributes:
        name: name of the checkpoint's directory.
        served: "<name>@<fingerprint>", the name given by servers of this package.
    """

    name: str
    served: str

    @classmethod
    def of(cls, checkpoint: Path) -> Expectation:
        """Read the identity of a checkpoint. Raises CheckpointError if its files cannot be read."""
        path = checkpoint.resolve()
        try:
            return cls(name=path.name, served=served_name(path))
        except OSError as error:
            raise CheckpointError(f"{path} cannot be read: {error}") from error

    def check(self, connection: HttpConnection, url: str, deadline_s: float) -> None:
        """Query one server and compare.

        Raises:
            ConfigurationError: it does not accept the API key.
            MissingDependencyError: its release is not supported.
            CheckpointError: it serves another model.
            NotReadyError: it does not answer, or its answers are malformed.
        """
        version = str(self._ask(connection, url, "/server_info", deadline_s).get("version"))
        if not is_supported(version):
            first, end = (".".join(map(str, numbers)) for numbers in SUPPORTED)
            raise MissingDependencyError(
                f"{url} runs SGLang {version}, supported is >={first},<{end}.",
                hint=f'Install a supported release: pip install "sglang>={first},<{end}".',
            )
        self._check_model(self._ask(connection, url, "/model_info", deadline_s), url)

    @staticmethod
    def _ask(
        connection: HttpConnection, url: str, path: str, deadline_s: float
    ) -> dict[str, object]:
        answer = connection.request("GET", path, deadline_s)
        if answer.status in (401, 403):
            raise ConfigurationError(
                f"{url} refused the API key (status {answer.status}).",
                hint="Set the environment variable that `key_variable` names to the server's key.",
            )
        if answer.status != 200:
            raise NotReadyError(f"{url}{path} answered {answer.status}: {error_text(answer.body)}")
        return parse_object(answer.body, f"The answer of {url}{path}")

    def _check_model(self, info: dict[str, object], url: str) -> None:
        architectures = info.get("architectures")
        if not isinstance(architectures, list) or ARCHITECTURE not in architectures:
            raise CheckpointError(
                f"{url} serves {info.get('model_path')!r} with the architecture {architectures!r}, "
                f"expected {ARCHITECTURE!r}.",
                hint="Start it by: python -m rn_runtime_sglang.served --model-path CHECKPOINT",
            )
        served = str(info.get("served_model_name"))
        if served == self.served:
            return
        if "@" in served or PurePath(str(info.get("model_path"))).name != self.name:
            raise CheckpointError(
                f"{url} serves {served!r} from {info.get('model_path')!r}, but the backend's "
                "checkpoint is "
                f"{self.served!r}.",
                hint="Serve that checkpoint there, or set `checkpoint` to a copy of the served "
                "one.",
            )
