from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rn_runtime_sglang.case import write_checkpoint
from rn_runtime_sglang.served.__main__ import to_arguments
from rn_runtime_sglang.served.fingerprint import fingerprint, served_name
from rn_runtime_sglang.served.versions import TESTED, is_supported
from rn_runtime_sglang.standin.site import write_site


@pytest.mark.parametrize("version", [*TESTED, "0.5.23.post1"])
def test_tried_releases_are_supported(version):
    assert is_supported(version)


@pytest.mark.parametrize("version", ["0.5.22", "0.5.24", "0.6.0", "1.0", "", "None", "0.x.1"])
def test_other_releases_are_not(version):
    assert not is_supported(version)


def test_copies_share_a_fingerprint_and_other_weights_or_statistics_do_not(tmp_path):
    first = write_checkpoint(tmp_path / "a")
    assert fingerprint(write_checkpoint(tmp_path / "b")) == fingerprint(first)
    assert fingerprint(write_checkpoint(tmp_path / "c", content="other!!")) != fingerprint(first)
    before = served_name(first)
    (first / "config.json").write_text('{"norm_stats": {}}', encoding="utf-8")
    assert served_name(first) != before


def options(**changes: object) -> argparse.Namespace:
    told = {"host": "127.0.0.1", "port": 30000, "device": "auto", "dtype": "auto", **changes}
    return argparse.Namespace(**told)


def test_the_cpu_gets_exact_arithmetic_and_its_own_attention(tmp_path, monkeypatch):
    monkeypatch.delenv("SGLANG_USE_CPU_ENGINE", raising=False)
    arguments = to_arguments(options(device="cpu"), write_checkpoint(tmp_path / "a"), "", [])
    assert arguments[arguments.index("--dtype") + 1] == "float32"
    assert arguments[arguments.index("--attention-backend") + 1] == "torch_native"
    assert "--api-key" not in arguments
    assert os.environ.pop("SGLANG_USE_CPU_ENGINE") == "1"


def test_what_a_user_adds_comes_last(tmp_path):
    arguments = to_arguments(options(), write_checkpoint(tmp_path / "a"), "secret", ["--tp", "2"])
    assert arguments[-2:] == ["--tp", "2"]
    assert arguments[arguments.index("--api-key") + 1] == "secret"
    assert "--enable-metrics" in arguments


def serve(tmp_path: Path, *arguments: str, site: Path | None) -> str:
    environment = {
        name: value for name, value in os.environ.items() if name != "ROBONEURON_SGLANG_KEY"
    }
    environment["PYTHONPATH"] = "" if site is None else str(site)
    command = [sys.executable, "-m", "rn_runtime_sglang.served", *arguments]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode != 0
    return done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--host", "0.0.0.0"), "needs an API key"),
        (("--trust-remote-code",), "would let requests or checkpoints run code"),
        (("--enable-custom-logit-processor=true",), "would let requests or checkpoints run code"),
        ((), "holds no config.json"),
    ],
)
def test_unsafe_or_wrong_commands_end_with_one_sentence(tmp_path, arguments, words):
    text = serve(
        tmp_path, "--model-path", str(tmp_path), *arguments, site=write_site(tmp_path / "site")
    )
    assert words in text
    assert "Traceback" not in text


def test_a_missing_sglang_ends_with_the_command_that_installs_it(tmp_path):
    assert 'pip install "sglang>=0.5.23,<0.5.24"' in serve(
        tmp_path, "--model-path", str(tmp_path), site=None
    )
