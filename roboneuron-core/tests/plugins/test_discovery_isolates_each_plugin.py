"""Discovery names the error of a plugin and keeps all others usable."""

from __future__ import annotations

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.plugins.registry import PluginRecord, Status
from roboneuron.plugins.specs import BackendSpec, RuntimeSpec

GOOD = """
@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="good", summary="Works.", target="good_module:Good")]
"""


def _backend(arguments: str) -> str:
    return f"""
@hookimpl
def roboneuron_backends():
    return [BackendSpec({arguments})]
"""


BROKEN = {
    "raises at import": ("1 / 0", Status.FAILED, "ZeroDivisionError"),
    "exits at import": ("raise SystemExit(3)", Status.FAILED, "SystemExit: 3"),
    "imports what is absent": (
        "import module_that_is_absent",
        Status.FAILED,
        "module_that_is_absent",
    ),
    "offers nothing": ("", Status.FAILED, "offers nothing"),
    "misspells a hook": (
        "@hookimpl\ndef roboneuron_backend(): return []",
        Status.FAILED,
        "roboneuron_backend is no hook. Did you mean 'roboneuron_backends'?",
    ),
    "misspells a hook without decorator": (
        "def roboneuron_robot(): return []",
        Status.FAILED,
        "Did you mean 'roboneuron_robots'?",
    ),
    "decorates what is no hook": (
        "@hookimpl\ndef backends(): return []",
        Status.FAILED,
        "backends is no hook",
    ),
    "forgets the decorator": (
        "def roboneuron_backends(): return []",
        Status.FAILED,
        "roboneuron_backends is not decorated",
    ),
    "takes an argument": (
        "@hookimpl\ndef roboneuron_backends(config): return []",
        Status.FAILED,
        "config",
    ),
    "raises in a hook": (
        "@hookimpl\ndef roboneuron_backends(): raise KeyError('weights')",
        Status.FAILED,
        "roboneuron_backends raised KeyError: 'weights'",
    ),
    "returns no sequence": (
        "@hookimpl\ndef roboneuron_backends(): return 3",
        Status.FAILED,
        "returned int",
    ),
    "returns None": (
        "@hookimpl\ndef roboneuron_backends(): return None",
        Status.FAILED,
        "returned None",
    ),
    "returns another type": (
        "@hookimpl\ndef roboneuron_backends(): return [{'name': 'x'}]",
        Status.FAILED,
        "returned dict {'name': 'x'}, expected a BackendSpec",
    ),
    "returns another kind": (
        "@hookimpl\ndef roboneuron_backends(): return [RuntimeSpec(name='x', summary='X.', "
        "target='m:X')]",
        Status.FAILED,
        "expected a BackendSpec",
    ),
    "is mutable": (
        _backend("name='x', summary='X.', target='m:X', cameras=['primary']"),
        Status.FAILED,
        "`cameras` of backend 'x' is list ['primary'], expected a tuple",
    ),
    "has a wrong type inside": (
        _backend("name='x', summary='X.', target='m:X', action_space=ActionSpace(width='7')"),
        Status.FAILED,
        "`width` of `action_space` of backend 'x' is str '7', expected int",
    ),
    "has a bad name": (
        _backend("name='Bad Name', summary='X.', target='m:X'"),
        Status.FAILED,
        "'Bad Name'",
    ),
    "has no summary": (_backend("name='x', summary=' ', target='m:X'"), Status.FAILED, "summary"),
    "has a bad target": (
        _backend("name='x', summary='X.', target='m.X'"),
        Status.FAILED,
        "`target` of backend 'x'",
    ),
    "has a bad config": (
        _backend("name='x', summary='X.', target='m:X', config='m'"),
        Status.FAILED,
        "`config` of backend 'x'",
    ),
    "has a bad case": (
        _backend("name='x', summary='X.', target='m:X', case='m'"),
        Status.FAILED,
        "`case` of backend 'x'",
    ),
    "requires a submodule": (
        _backend(
            "name='x', summary='X.', target='m:X', requires=(Requirement(module='a.b', "
            "install='-'),)"
        ),
        Status.FAILED,
        "requires 'a.b', expected a top-level module name",
    ),
    "has two drivers of one name": (
        "d = DriverSpec(name='d', summary='D.', target='m:D')\n@hookimpl\ndef roboneuron_robots():"
        " return [RobotSpec(name='x', summary='X.', target='m:x', drivers=(d, d))]",
        Status.FAILED,
        "drivers of robot 'x' hold the name 'd' twice",
    ),
    "has a driver with a bad target": (
        "d = DriverSpec(name='d', summary='D.', target='m')\n@hookimpl\ndef roboneuron_robots():"
        " return [RobotSpec(name='x', summary='X.', target='m:x', drivers=(d,))]",
        Status.FAILED,
        "`target` of driver 'd' of robot 'x' is 'm'",
    ),
    "has an unknown kind of robot": (
        "d = DriverSpec(name='d', summary='D.', target='m:D')\n@hookimpl\ndef roboneuron_robots():"
        " return [RobotSpec(name='x', summary='X.', target='m:x', drivers=(d,), "
        "robot_kind='boat')]",
        Status.FAILED,
        "robot_kind of robot 'x' is 'boat', expected one of arm, base",
    ),
    "claims one name twice by itself": (
        "@hookimpl\ndef roboneuron_backends(): return 2 * [BackendSpec(name='x', summary='X.', "
        "target='m:X')]",
        Status.CONFLICT,
        "claimed by rn-zzz-broken and by rn-zzz-broken",
    ),
    "lacks a module": (
        _backend(
            "name='x', summary='X.', target='m:X', requires=(Requirement(module='absent_x', "
            "install='pip install x'),)"
        ),
        Status.UNAVAILABLE,
        "Needs 'absent_x', not installed; run: pip install x",
    ),
    "is newer than the core": (
        _backend("name='x', summary='X.', target='m:X', contract=99"),
        Status.INCOMPATIBLE,
        "contract 99",
    ),
    "has a robot without drivers": (
        "@hookimpl\ndef roboneuron_robots(): return [RobotSpec(name='x', summary='X.', "
        "target='m:x')]",
        Status.FAILED,
        "robot 'x' has no drivers",
    ),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_plugin_is_named_and_hurts_nobody_else(site, fault):
    source, status, words = BROKEN[fault]
    site.install("rn-good", GOOD)
    site.install("rn-zzz-broken", source)
    registry = site.discover()
    good, broken = registry.plugins
    assert (good.distribution, good.status, good.reason) == ("rn-good", Status.READY, "")
    assert list(registry.specs(BackendSpec)) == ["good"]
    assert broken.status is status
    assert words in broken.reason
    assert bool(broken.traceback) == (status is Status.FAILED)


def test_an_entry_point_to_an_absent_module_is_a_failure(site):
    site.install("rn-lost", GOOD, value="rn_lost_no_such_module")
    (record,) = site.discover().plugins
    assert record.status is Status.FAILED
    assert "rn_lost_no_such_module" in record.reason


def test_two_claims_on_one_name_disable_both_and_name_both(site):
    other = (
        '\n@hookimpl\ndef roboneuron_runtimes(): return [RuntimeSpec(name="r", summary="R.", '
        'target="m:R")]\n'
    )
    site.install("rn-one", GOOD + other)
    site.install("rn-two", GOOD)
    registry = site.discover()
    assert dict(registry.specs(BackendSpec)) == {}
    assert list(registry.specs(RuntimeSpec)) == ["r"]
    assert [p.status for p in registry.plugins] == [Status.CONFLICT, Status.CONFLICT]
    assert all("rn-one" in p.reason and "rn-two" in p.reason for p in registry.plugins)
    with pytest.raises(
        ConfigurationError,
        match="claimed by rn-one and by rn-two; uninstall or disable all but one",
    ):
        registry.get(BackendSpec, "good")


def test_one_name_in_two_kinds_is_no_conflict(site):
    other = (
        '\n@hookimpl\ndef roboneuron_runtimes(): return [RuntimeSpec(name="good", '
        'summary="R.", target="m:R")]\n'
    )
    site.install("rn-one", GOOD + other)
    assert site.discover().plugins[0].status is Status.READY


def test_a_disabled_plugin_is_never_imported(site):
    site.install("rn-bomb", "raise RuntimeError('imported')")
    (record,) = site.discover(disabled=["RN_Bomb"]).plugins
    assert record.status is Status.DISABLED
    assert record.traceback == ""


def _telling(body):
    """A plugin whose feature is notified of its discovery."""
    return f"""
def told():
    {body}
@hookimpl
def roboneuron_features():
    return [FeatureSpec(name="x", summary="X.", target="m:X", on_discovery=__name__ + ":told")]
"""


def test_a_feature_is_told_of_its_discovery_unless_it_is_disabled(site, capsys):
    site.install("rn-told", _telling("print('discovered')"))
    (record,) = site.discover(disabled=["rn-told"]).plugins
    assert capsys.readouterr().err == ""
    (record,) = site.discover().plugins
    assert record.status is Status.READY
    assert capsys.readouterr().err == "discovered\n"


def test_a_feature_that_fails_on_its_discovery_is_named(site):
    site.install("rn-told", _telling("raise OSError('no disk')"))
    (record,) = site.discover().plugins
    assert record.status is Status.FAILED
    assert "no disk" in record.reason


def test_disabling_what_is_not_installed_names_the_nearest(site):
    site.install("rn-good", GOOD)
    with pytest.raises(
        ConfigurationError, match=r"'rn-god' is not installed\. Did you mean 'rn-good'"
    ):
        site.discover(disabled=["rn-god"])


def test_what_a_plugin_prints_at_import_stays_off_stdout(site, capsys):
    site.install("rn-loud", GOOD + "\nprint('hello')")
    site.discover()
    out, err = capsys.readouterr()
    assert (out, err) == ("", "hello\n")


def test_records_say_where_they_come_from(site):
    site.install("rn-good", GOOD, version="2.5")
    (record,) = site.discover().plugins
    assert isinstance(record, PluginRecord)
    assert (record.version, record.module) == ("2.5", "rn_good_plugin")
    assert [o.spec.name for o in record.offers] == ["good"]
