"""A directory that looks like an installed SGLang: on the Python path, it replaces `python -m
sglang.launch_server`.
"""

from __future__ import annotations

from pathlib import Path

_MAIN = '''"""Takes SGLang's command line and serves as the stand-in does."""

import argparse
import os
import sys
import time

from rn_runtime_sglang.standin.server import Behaviour, StandInServer

print(f"server_args={sys.argv}", flush=True)
if os.environ.get("STANDIN_CRASH"):
    print(f"api_key={sys.argv[sys.argv.index('--api-key') + 1]!r}", flush=True)
    print("RuntimeError: CUDA out of memory. Tried to allocate 14.96 GiB", flush=True)
    sys.exit(7)
parser = argparse.ArgumentParser()
parser.add_argument("--model-path")
parser.add_argument("--served-model-name")
parser.add_argument("--port", type=int)
parser.add_argument("--api-key", default="")
options, _ = parser.parse_known_args()
time.sleep(float(os.environ.get("STANDIN_START_S", "0")))
StandInServer(Behaviour(served_name=options.served_model_name, model_path=options.model_path, key=options.api_key),
        options.port).serve()
'''  # noqa: E501


def write_site(directory: Path, version: str = "0.5.23") -> Path:
    """Write the package `sglang` and its metadata into `directory`; returns it, for PYTHONPATH."""
    package = directory / "sglang"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("", encoding="utf-8")
    (package / "launch_server.py").write_text(_MAIN, encoding="utf-8")
    metadata = directory / f"sglang-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.4\nName: sglang\nVersion: {version}\n", encoding="utf-8"
    )
    return directory
