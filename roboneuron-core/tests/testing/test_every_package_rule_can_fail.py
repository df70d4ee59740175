"""For each package rule there is a distribution that breaks it; the good one they are made from keeps all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from roboneuron.testing import PackageCase, PackageContract, Verdict, verify
from roboneuron.testing.rules import RULES

PLUGIN = """
from roboneuron.plugins.markers import hookimpl
from roboneuron.plugins.specs import BackendSpec

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

    def drop(self, line: str) -> None:
        """Take the metadata line that starts with `line` away."""
        kept = [text for text in METADATA.splitlines(keepends=True) if not text.startswith(line)]
        (self.info / "METADATA").write_text("".join(kept))


@pytest.fixture
def sample(tmp_path: Path) -> Sample:
    made = Sample(tmp_path / "sample")
    made.package.mkdir(parents=True)
    made.info.mkdir()
    (made.package / "__init__.py").write_text('"""A sample."""\n')
    (made.package / "plugin.py").write_text(PLUGIN)
    (made.package / "policy.py").write_text("import numpy\nfrom roboneuron.contract import Observation\n")
    (made.package / "py.typed").touch()
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
    return lambda sample: (sample.info / "entry_points.txt").write_text(f"[roboneuron]\nrn-sample = {value}\n")


BROKEN: dict[str, tuple[str, Callable[[Sample], object]]] = {
    "no entry point": ("package/entry-point", lambda s: (s.info / "entry_points.txt").write_text("")),
    "entry point elsewhere": ("package/entry-point", _entry("rn_sample.hooks")),
    "entry point with attribute": ("package/entry-point", _entry("rn_sample.plugin:hooks")),
    "misspelled hook": ("package/hooks-usable", _write("plugin.py", PLUGIN.replace("_backends", "_backend"))),
    "heavy plugin module": ("package/plugin-module-light", _write("plugin.py", "import numpy\n" + PLUGIN)),
    "heavy package": ("package/plugin-module-light", _write("__init__.py", "import pydantic\n")),
    "no py.typed": ("package/typed", lambda s: (s.package / "py.typed").unlink()),
    "no readme": ("package/readme", lambda s: s.drop("# rn-sample")),
    "no summary": ("package/summary", lambda s: s.drop("Summary")),
    "no licence": ("package/licence", lambda s: s.drop("License-Expression")),
    "no licence file": ("package/licence", lambda s: s.drop("License-File")),
    "no python": ("package/requires-python", lambda s: s.drop("Requires-Python")),
    "no core": ("package/requires-core", lambda s: s.drop("Requires-Dist")),
    "imports the server": ("package/import-direction", _write("policy.py", "from roboneuron.server import app\n")),
    "imports a module late": (
        "package/import-direction",
        _write("policy.py", "def load():\n    from roboneuron import supervisor\n"),
    ),
    "imports a sibling": ("package/siblings-declared", _write("policy.py", "import rn_other.network\n")),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_package_fails_its_rule(sample, site, fault):
    site.install("rn-other", "", value="rn_other.plugin")
    rule_id, damage = BROKEN[fault]
    damage(sample)
    rule = next(r for r in RULES["package"] if r.id == rule_id)
    outcome = verify(rule, sample.case())
    assert outcome.verdict is Verdict.FAILED, outcome


def test_every_package_rule_has_a_package_that_breaks_it():
    assert {rule for rule, _ in BROKEN.values()} == {rule.id for rule in RULES["package"]}


def test_a_distribution_that_is_not_installed_is_named(sample):
    case = PackageCase(distribution="rn-absent", path=(str(sample.root),))
    outcome = verify(RULES["package"][0], case)
    assert outcome.detail == "rn-absent is not installed"
