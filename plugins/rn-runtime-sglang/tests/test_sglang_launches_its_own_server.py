from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import socket
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rn_runtime_sglang import process
from rn_runtime_sglang.case import token_request
from rn_runtime_sglang.config import SglangRuntimeConfig
from rn_runtime_sglang.runtime import SglangRuntime
from rn_runtime_sglang.standin.site import write_site
from roboneuron.errors import ConfigurationError, MissingDependencyError, NotReadyError

BROUGHT_BY_SGLANG = {
    "anyio",  # required by httpx2
    "httpx2",  # transformers loads it if the hub's client uses it
    "numpy",
    "pillow",
    "pydantic",
    "pydantic-core",
    "safetensors",
    "tokenizers",
    "torch",
    "transformers",
    "typing-extensions",  # required by pydantic
}


def managed(site: Path, **options: object) -> SglangRuntime:
    told = {
        "python": sys.executable,
        "poll_s": 0.1,
        "start_timeout_s": 30.0,
        "log": site.parent / "log",
        **options,
    }
    environment = {"PYTHONPATH": str(site), **told.pop("environment", {})}  # type: ignore[dict-item]
    return SglangRuntime(SglangRuntimeConfig(**told, environment=environment))  # type: ignore[arg-type]


@pytest.fixture
def site(tmp_path: Path) -> Path:
    return write_site(tmp_path / "site")


def _server() -> psutil.Process:
    found = [c for c in psutil.Process().children() if "rn_runtime_sglang.served" in c.cmdline()]
    assert len(found) == 1
    return found[0]


def test_a_launched_server_answers_and_is_gone_after_close(site, model):
    runtime = managed(site)
    runtime.load(model)
    server = _server()
    assert runtime.run(token_request()).tokens.size == 7
    assert os.getpgid(server.pid) == server.pid
    runtime.close()
    assert not server.is_running()


def test_the_key_is_in_no_command_line_and_without_it_nobody_gets_in(site, model, tmp_path):
    log = tmp_path / "server.log"
    runtime = managed(site, log=log)
    runtime.load(model)
    try:
        key = _key(log)
        assert key
        assert not any(key in part for part in _server().cmdline())
        assert log.stat().st_mode & 0o077 == 0
    finally:
        runtime.close()


def _key(log: Path) -> str:
    arguments = eval(log.read_text(encoding="utf-8").partition("server_args=")[2].splitlines()[0])
    return str(arguments[arguments.index("--api-key") + 1])


def test_no_server_is_launched_that_would_run_code_of_others(site, model):
    runtime = managed(site, server_arguments=("--enable-custom-logit-processor",))
    with pytest.raises(NotReadyError, match="would let requests or checkpoints run code"):
        runtime.load(model)


def test_sglang_that_is_not_installed_is_named_with_the_command(tmp_path, model):
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        MissingDependencyError, match=r"SGLang is not installed.*tried with 0\.5\.23"
    ):
        managed(tmp_path / "empty").load(model)


def test_what_the_served_half_lacks_is_named_with_the_command(site, model, monkeypatch):
    monkeypatch.setattr(process, "NEEDED", ("not-installed-here",))
    with pytest.raises(
        MissingDependencyError, match="not-installed-here must be installed"
    ) as caught:
        managed(site).load(model)
    assert "pip install not-installed-here; " in caught.value.hint


@pytest.mark.exhaustive
def test_the_served_half_needs_nothing_that_nobody_installs():
    """SGLang's environment holds SGLang's requirements and NEEDED, but no other requirements of
    RoboNeuron's packages.
    """
    own = "rn_runtime_sglang.served.fingerprint", "rn_runtime_sglang.served.configuration"
    models = (
        "rn_vla.openvla.checkpoint",
        "rn_vla.openvla.front",
        "rn_vla.openvla.preprocessing",
        "rn_vla.openvla.prompt",
    )
    code = (
        f"import {', '.join((*own, *models))}; import json, sys; "
        "print(json.dumps(sorted(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, timeout=120, check=True, text=True
    )
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}
    distributions = importlib.metadata.packages_distributions()
    imported = {canonicalize_name(name) for top in loaded for name in distributions.get(top, ())}
    required = {
        canonicalize_name(Requirement(line).name)
        for name in process.OURS
        for line in importlib.metadata.requires(name) or ()
        if "extra ==" not in line
    }
    assert imported & required - BROUGHT_BY_SGLANG == set(process.NEEDED)


def test_another_release_is_named_with_the_supported_ones(tmp_path, model):
    with pytest.raises(
        MissingDependencyError,
        match=r"SGLang 0\.6\.0 is installed.*supported is >=0\.5\.23,<0\.5\.24",
    ):
        managed(write_site(tmp_path / "newer", "0.6.0")).load(model)


def test_a_python_that_does_not_exist_is_named(site, model, tmp_path):
    with pytest.raises(ConfigurationError, match="cannot be run"):
        managed(site, python=tmp_path / "bin" / "python").load(model)


def test_a_port_that_is_taken_is_named(site, model):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigurationError, match=f"Port {port} of this machine is taken"):
            managed(site, port=port).load(model)


def test_a_crash_at_start_shows_its_last_lines_but_not_the_key(site, model):
    runtime = managed(site, environment={"STANDIN_CRASH": "1"})
    with pytest.raises(
        NotReadyError, match=r"ended with status 7(.|\n)*CUDA out of memory"
    ) as caught:
        runtime.load(model)
    assert "api_key='***'" in str(caught.value)


@pytest.mark.exhaustive
def test_a_server_that_never_gets_ready_is_ended(site, model):
    runtime = managed(site, environment={"STANDIN_START_S": "60"}, start_timeout_s=4.0)
    with pytest.raises(
        NotReadyError, match=r"became ready within 4 s(.|\n)*last lines(.|\n)*server_args="
    ):
        runtime.load(model)
    assert not [c for c in psutil.Process().children() if "rn_runtime_sglang.served" in c.cmdline()]


def test_a_server_killed_during_motion_is_an_error_with_its_end(site, model):
    runtime = managed(site)
    runtime.load(model)
    try:
        server = _server()
        server.send_signal(signal.SIGKILL)
        deadline_s = time.monotonic() + 5.0
        while "was ended by SIGKILL" not in (text := _error(runtime)):
            assert time.monotonic() < deadline_s, text
    finally:
        runtime.close()


def _error(runtime: SglangRuntime) -> str:
    try:
        runtime.run(token_request())
    except NotReadyError as error:
        return str(error)
    return ""


def test_a_server_ends_with_the_process_that_launched_it(site, checkpoint):
    program = f"""
        import sys, time
        from pathlib import Path
        import psutil
        from rn_runtime_sglang.case import policy_model
        from rn_runtime_sglang.config import SglangRuntimeConfig
        from rn_runtime_sglang.runtime import SglangRuntime
        runtime = SglangRuntime(SglangRuntimeConfig(
            python=sys.executable, environment={{"PYTHONPATH": {str(site)!r}}}, poll_s=0.1))
        runtime.load(policy_model(Path({str(checkpoint)!r})))
        print([c.pid for c in psutil.Process().children()][0], flush=True)
        time.sleep(60)
    """
    owner = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program)], stdout=subprocess.PIPE, text=True
    )
    with owner:
        assert owner.stdout is not None
        server = psutil.Process(int(owner.stdout.readline()))
        owner.kill()
    server.wait(5.0)
    assert not server.is_running()
