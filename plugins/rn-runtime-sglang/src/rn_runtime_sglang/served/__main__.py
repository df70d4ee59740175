"""`python -m rn_runtime_sglang.served --model-path DIRECTORY`: an SGLang server for an OpenVLA
checkpoint.

Run it with the interpreter of SGLang's environment. Unknown options are passed on to SGLang
(`--tp`, `--dp`, `--mem-fraction-static` ...). The API key is read from the environment variable
ROBONEURON_SGLANG_KEY, so that no process list shows it.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import runpy
import signal
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rn_runtime_sglang.served.fingerprint import served_name
from rn_runtime_sglang.served.versions import SUPPORTED, is_supported

KEY_VARIABLE = "ROBONEURON_SGLANG_KEY"
REFUSED = ("--enable-custom-logit-processor", "--trust-remote-code")
"""Options of SGLang that would run code from requests (unpickled) or from the checkpoint's
directory.
"""
_PR_SET_PDEATHSIG = 1
_PACKAGE = "rn_runtime_sglang.served"
_ENVIRONMENT = {
    "SGLANG_EXTERNAL_MODEL_PACKAGE": f"{_PACKAGE}.models",
    "SGLANG_EXTERNAL_MM_MODEL_ARCH": "OpenVLAForActionPrediction",
    "SGLANG_EXTERNAL_MM_PROCESSOR_PACKAGE": f"{_PACKAGE}.processors",
    "HF_HUB_OFFLINE": "1",
}
# The CPU path needs these; memory for 4096 positions is 14 requests of OpenVLA.
_CPU = {
    "--attention-backend": "torch_native",
    "--sampling-backend": "pytorch",
    "--max-total-tokens": "4096",
    "--max-running-requests": "4",
}
_CPU_FLAGS = ("--disable-overlap-schedule", "--sleep-on-idle")


def main() -> None:
    """Check the environment, print what is served, and become the SGLang server."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {_PACKAGE}", description=__doc__, allow_abbrev=False
    )
    parser.add_argument(
        "--model-path", type=Path, required=True, help="checkpoint directory in the public layout"
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: this machine only)"
    )
    parser.add_argument("--port", type=int, default=30000)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--dtype", default="auto", help="auto, float32, bfloat16 or float16")
    parser.add_argument("--parent", type=int, help="id of the process with which to end")
    options, others = parser.parse_known_args()
    if options.parent is not None:
        end_with(options.parent)
    check_version()
    refused = [name for name in REFUSED if any(other.partition("=")[0] == name for other in others)]
    if refused:
        sys.exit(
            f"{', '.join(refused)} would let requests or checkpoints run code; it is not "
            "available here."
        )
    key = os.environ.pop(KEY_VARIABLE, "")
    if not key and options.host not in ("127.0.0.1", "::1", "localhost"):
        sys.exit(
            f"Listening on {options.host} needs an API key: set the environment variable "
            f"{KEY_VARIABLE}."
        )
    checkpoint = options.model_path.resolve()
    if not (checkpoint / "config.json").is_file():
        sys.exit(f"{checkpoint} holds no config.json; --model-path must be a checkpoint directory.")
    os.environ.update(_ENVIRONMENT)
    arguments = to_arguments(options, checkpoint, key, others)
    sys.argv = ["sglang.launch_server", *arguments]
    runpy.run_module("sglang.launch_server", run_name="__main__", alter_sys=True)


def to_arguments(
    options: argparse.Namespace, checkpoint: Path, key: str, others: list[str]
) -> list[str]:
    """SGLang's own command line; the user's options (`others`) come last and take precedence."""
    named = {
        "--model-path": str(checkpoint),
        "--served-model-name": served_name(checkpoint),
        "--host": options.host,
        "--port": str(options.port),
        "--grammar-backend": "none",
    }
    dtype = options.dtype
    flags = ["--skip-tokenizer-init", "--enable-metrics", "--skip-server-warmup"]
    if options.device == "cpu":
        os.environ["SGLANG_USE_CPU_ENGINE"] = "1"
        named |= {"--device": "cpu", **_CPU}
        flags += _CPU_FLAGS
        dtype = "float32" if dtype == "auto" else dtype
    elif options.device == "cuda":
        named["--device"] = "cuda"
    named["--dtype"] = dtype
    if key:
        named["--api-key"] = key
    return [*(text for pair in named.items() for text in pair), *flags, *others]


def check_version() -> None:
    """Exit with one sentence unless a supported SGLang is installed."""
    first, end = (".".join(map(str, numbers)) for numbers in SUPPORTED)
    wanted = f'pip install "sglang>={first},<{end}"'
    try:
        found = version("sglang")
    except PackageNotFoundError:
        sys.exit(f"SGLang is not installed for {sys.executable}; run there: {wanted}")
    if not is_supported(found):
        sys.exit(
            f"SGLang {found} is installed for {sys.executable}, supported is >={first},<{end}; "
            f"run there: {wanted}"
        )


def end_with(parent: int) -> None:
    """Request SIGKILL from the kernel at the parent's death; SGLang's own children do the same with
    this process.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
    if os.getppid() != parent:
        sys.exit("The parent process of this server has ended.")


if __name__ == "__main__":
    main()
