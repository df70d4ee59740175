"""Each package rule is broken by some distribution; the good one from which they derive keeps all
rules.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from rn_testing import PackageCase, PackageContract, RuleVerdict, verify
from rn_testing.rules import RULES, installed
from rn_testing.unsafe_calls import unsafe_calls
from roboneuron import BackendSpec, FeatureSpec
from roboneuron.plugins.registry import Offer, Registry, Status

PLUGIN = """
from roboneuron import BackendSpec, hookimpl

@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="sample", summary="A sample.", target="rn_sample.policy:Sample")]
"""
METADATA = """\
Metadata-Version: 2.4
Name: rn-sample
Version: 1.0
Summary: A sample.
License-Expression: Apache-2.0
License-File: LICENSE
Requires-Python: >=3.11
Requires-Dist: roboneuron-core<0.2,>=0.1

# rn-sample
"""
IN_AN_EXTRA = METADATA.replace("\n\n#", "\nRequires-Dist: rn-testing; extra == 'testing'\n\n#")
"""METADATA with the contract kit in an extra."""


@dataclass(frozen=True)
class Sample:
    """A good distribution on disk."""

    root: Path

    @property
    def package(self) -> Path:
        return self.root / "rn_sample"

    @property
    def info(self) -> Path:
        return self.root / "rn_sample-1.0.dist-info"

    def case(self) -> PackageCase:
        return PackageCase(distribution="rn-sample", path=(str(self.root),))

    def change(self, old: str, new: str) -> None:
        """Replace `old` by `new` in the metadata."""
        (self.info / "METADATA").write_text(METADATA.replace(old, new))

    def module(self, name: str, text: str) -> None:
        """Add a module to the package."""
        (self.root / f"{name}.py").write_text(text)

    def drop(self, line: str) -> None:
        """Remove the metadata line that starts with `line`."""
        kept = [text for text in METADATA.splitlines(keepends=True) if not text.startswith(line)]
        (self.info / "METADATA").write_text("".join(kept))


@pytest.fixture
def sample(tmp_path: Path) -> Sample:
    made = Sample(tmp_path / "sample")
    made.package.mkdir(parents=True)
    made.info.mkdir()
    (made.package / "__init__.py").write_text('"""A sample."""\n')
    (made.package / "plugin.py").write_text(PLUGIN)
    (made.package / "policy.py").write_text("import numpy\nfrom roboneuron import Observation\n")
    (made.package / "py.typed").touch()
    (made.info / "licenses").mkdir()
    (made.info / "licenses" / "LICENSE").write_text("Permission is granted ...")
    (made.info / "METADATA").write_text(METADATA)
    (made.info / "entry_points.txt").write_text("[roboneuron]\nrn-sample = rn_sample.plugin\n")
    return made


class TestGoodPackage(PackageContract):
    @pytest.fixture
    def plugin(self, sample: Sample) -> PackageCase:
        return sample.case()


def _write(name: str, text: str) -> Callable[[Sample], object]:
    return lambda sample: (sample.package / name).write_text(text)


def _entry(value: str) -> Callable[[Sample], object]:
    return lambda sample: (sample.info / "entry_points.txt").write_text(
        f"[roboneuron]\nrn-sample = {value}\n"
    )


BROKEN: dict[str, tuple[str, Callable[[Sample], object]]] = {
    "no entry point": (
        "package/entry-point",
        lambda s: (s.info / "entry_points.txt").write_text(""),
    ),
    "entry point elsewhere": ("package/entry-point", _entry("rn_sample.hooks")),
    "entry point with attribute": ("package/entry-point", _entry("rn_sample.plugin:hooks")),
    "misspelled hook": (
        "package/hooks-usable",
        _write("plugin.py", PLUGIN.replace("_backends", "_backend")),
    ),
    "heavy plugin module": (
        "package/plugin-module-light",
        _write("plugin.py", "import numpy\n" + PLUGIN),
    ),
    "heavy package": ("package/plugin-module-light", _write("__init__.py", "import pydantic\n")),
    "no py.typed": ("package/typed", lambda s: (s.package / "py.typed").unlink()),
    "no readme": ("package/readme", lambda s: s.drop("# rn-sample")),
    "no summary": ("package/summary", lambda s: s.drop("Summary")),
    "no licence": ("package/licence", lambda s: s.drop("License-Expression")),
    "no licence file": ("package/licence", lambda s: s.drop("License-File")),
    "licence file empty": (
        "package/licence",
        lambda s: (s.info / "licenses" / "LICENSE").write_text("\n"),
    ),
    "licence file absent": (
        "package/licence",
        lambda s: (s.info / "licenses" / "LICENSE").unlink(),
    ),
    "python with an upper bound only": (
        "package/requires-python",
        lambda s: s.change(">=3.11", "<3.14"),
    ),
    "core without bounds": (
        "package/requires-core",
        lambda s: s.change("roboneuron-core<0.2,>=0.1", "roboneuron-core"),
    ),
    "core in an extra": (
        "package/requires-core",
        lambda s: s.change("roboneuron-core<0.2,>=0.1", 'roboneuron-core<0.2,>=0.1; extra == "x"'),
    ),
    "imports cv2 with the plugin module": (
        "package/plugin-module-light",
        lambda s: (
            (s.package / "plugin.py").write_text("import yaml_like\n" + PLUGIN),
            s.module("yaml_like", ""),
        ),
    ),
    "hook of another signature": (
        "package/hooks-usable",
        _write("plugin.py", PLUGIN.replace("():", "(robot):")),
    ),
    "hook without marker": (
        "package/hooks-usable",
        _write("plugin.py", PLUGIN.replace("@hookimpl", "")),
    ),
    "hook returns a generator": (
        "package/hooks-usable",
        _write("plugin.py", PLUGIN.replace("return [", "yield [")),
    ),
    "plugin module raises": ("package/hooks-usable", _write("plugin.py", "1 / 0\n")),
    "plugin module prints": (
        "package/plugin-module-pure",
        _write("plugin.py", "print('hello')\n" + PLUGIN),
    ),
    "plugin module starts a thread": (
        "package/plugin-module-pure",
        _write(
            "plugin.py",
            "import threading, time\nthreading.Thread(target=time.sleep, args=(9,), "
            "daemon=True).start()\n" + PLUGIN,
        ),
    ),
    "plugin module starts a process": (
        "package/plugin-module-pure",
        _write("plugin.py", "import subprocess\nsubprocess.run(['true'])\n" + PLUGIN),
    ),
    "plugin module writes a file": (
        "package/plugin-module-pure",
        _write("plugin.py", "open(__file__ + '.log', 'w').close()\n" + PLUGIN),
    ),
    "plugin module computes": (
        "package/plugin-module-pure",
        _write("plugin.py", "import time\nwhile time.thread_time() < 1.5: pass\n" + PLUGIN),
    ),
    "imports what it does not declare": (
        "package/imports-declared",
        _write("policy.py", "import pytest\n"),
    ),
    "imports late what it does not declare": (
        "package/imports-declared",
        _write("policy.py", "def load():\n    import pytest\n"),
    ),
    "imports the gate": (
        "package/import-direction",
        _write("policy.py", "from roboneuron.gate import limits\n"),
    ),
    "imports ros": (
        "package/import-direction",
        _write("policy.py", "import roboneuron.ros.node\n"),
    ),
    "imports the server by name": (
        "package/import-direction",
        _write("policy.py", "import importlib\nimportlib.import_module('roboneuron.server')\n"),
    ),
    "uses what a module for features does not open": (
        "package/import-direction",
        _write("policy.py", "from roboneuron.feature import topics as t\nprint(t.JOINT_COMMAND)\n"),
    ),
    "a file that is no Python": ("package/import-direction", _write("policy.py", "def (:\n")),
    "no python": ("package/requires-python", lambda s: s.drop("Requires-Python")),
    "no core": ("package/requires-core", lambda s: s.drop("Requires-Dist")),
    "imports the server": (
        "package/import-direction",
        _write("policy.py", "from roboneuron.server import app\n"),
    ),
    "imports a module late": (
        "package/import-direction",
        _write("policy.py", "def load():\n    from roboneuron import supervisor\n"),
    ),
    "imports the kit where users run it": (
        "package/kit-in-cases-only",
        lambda s: (
            (s.info / "METADATA").write_text(IN_AN_EXTRA),
            (s.package / "policy.py").write_text("from rn_testing.fakes import MemoryTopics\n"),
        ),
    ),
    "unpickles": (
        "package/no-unsafe-calls",
        _write("policy.py", "import pickle\npickle.load(open('m', 'rb'))\n"),
    ),
    "unpickles by another name": (
        "package/no-unsafe-calls",
        _write("policy.py", "from pickle import loads as read\ndef load(b):\n    return read(b)\n"),
    ),
    "loads tensors with code": (
        "package/no-unsafe-calls",
        _write("policy.py", "import torch\ntorch.load('m.pt')\n"),
    ),
    "loads arrays with code": (
        "package/no-unsafe-calls",
        _write("policy.py", "import numpy as np\nnp.load('m.npy', allow_pickle=True)\n"),
    ),
    "runs text": ("package/no-unsafe-calls", _write("policy.py", "eval('1 + 1')\n")),
    "runs a shell": (
        "package/no-unsafe-calls",
        _write("policy.py", "import subprocess\nsubprocess.run('ls', shell=True)\n"),
    ),
    "runs YAML": (
        "package/no-unsafe-calls",
        _write("policy.py", "import yaml\nyaml.load('a: 1', yaml.Loader)\n"),
    ),
    "imports a sibling": (
        "package/siblings-declared",
        _write("policy.py", "import rn_other.network\n"),
    ),
}


@pytest.mark.sampled(every=8)
@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_package_fails_its_rule(sample, site, fault):
    site.install("rn-other", "", value="rn_other.plugin")
    rule_id, damage = BROKEN[fault]
    damage(sample)
    rule = next(r for r in RULES["package"] if r.id == rule_id)
    outcome = verify(rule, sample.case())
    assert outcome.verdict is RuleVerdict.FAILED, outcome


@pytest.mark.parametrize(
    "line",
    [
        "import torch; torch.load('m.pt', weights_only=True)",
        "import numpy as np; np.load('m.npy')",
        "import yaml; yaml.load('a: 1', Loader=yaml.SafeLoader)",
        "import subprocess; subprocess.run(['ls'], shell=False)",
        "network.eval(); self.exec(); json.load(file)",
    ],
)
def test_calls_that_only_look_unsafe_pass(tmp_path, line):
    (tmp_path / "policy.py").write_text(line)
    assert not list(unsafe_calls(tmp_path / "policy.py"))


def test_every_package_rule_has_a_package_that_breaks_it():
    assert {rule for rule, _ in BROKEN.values()} == {rule.id for rule in RULES["package"]}


def test_the_module_of_a_case_may_import_the_kit(sample, monkeypatch):
    spec = BackendSpec(
        name="sample",
        summary="A sample.",
        target="rn_sample.policy:Sample",
        case="rn_sample.policy:make",
    )
    offer = Offer(spec=spec, plugin="rn-sample", distribution="rn-sample", status=Status.READY)
    monkeypatch.setattr(installed, "plugins", lambda: Registry(plugins=(), all_offers=(offer,)))
    (sample.info / "METADATA").write_text(IN_AN_EXTRA)
    (sample.package / "policy.py").write_text("from rn_testing import BackendCase\n")
    assert {verify(r, sample.case()).verdict for r in RULES["package"]} == {RuleVerdict.PASSED}


def test_a_package_with_features_may_import_what_features_may_use(sample, monkeypatch):
    spec = FeatureSpec(name="sample", summary="A sample.", target="rn_sample.policy:Sample")
    offer = Offer(spec=spec, plugin="rn-sample", distribution="rn-sample", status=Status.READY)
    monkeypatch.setattr(installed, "plugins", lambda: Registry(plugins=(), all_offers=(offer,)))
    (sample.package / "policy.py").write_text(
        "from roboneuron import Feature\nfrom roboneuron.feature import Config\n"
    )
    rule = next(r for r in RULES["package"] if r.id == "package/import-direction")
    assert verify(rule, sample.case()).verdict is RuleVerdict.PASSED
    (sample.package / "policy.py").write_text("from roboneuron.server import host\n")
    assert verify(rule, sample.case()).verdict is RuleVerdict.FAILED
    (sample.package / "policy.py").write_text("from roboneuron.feature import RosLink\n")
    assert verify(rule, sample.case()).verdict is RuleVerdict.FAILED
    for name, verdict in (
        ("PREDICTIONS", RuleVerdict.PASSED),
        ("JOINT_COMMAND", RuleVerdict.FAILED),
    ):
        text = f"from roboneuron.feature import topics\nprint(topics.{name})\n"
        (sample.package / "policy.py").write_text(text)
        assert verify(rule, sample.case()).verdict is verdict


def test_a_subpackage_that_another_program_loads_may_import_what_that_has(sample):
    hosted = sample.package / "served"
    hosted.mkdir()
    (hosted / "registration.py").write_text("import pytest\n")
    points = (
        "[roboneuron]\nrn-sample = rn_sample.plugin\n[host.plugins]\nsample = "
        "rn_sample.served.registration:go\n"
    )
    (sample.info / "entry_points.txt").write_text(points)
    rule = next(r for r in RULES["package"] if r.id == "package/imports-declared")
    assert verify(rule, sample.case()).verdict is RuleVerdict.PASSED


def test_a_distribution_that_is_not_installed_is_named(sample):
    case = PackageCase(distribution="rn-absent", path=(str(sample.root),))
    outcome = verify(RULES["package"][0], case)
    assert outcome.detail == "rn-absent is not installed"
