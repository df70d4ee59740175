"""Faults seeded into the wiring of a known policy are named; without one there is no alarm."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from policy_datasets import write_dataset
from policy_world import RATE_HZ, SPACES, KnowingPolicy, arm_profile, recorded
from wiring_faults import FAULTS

from rn_recorder_policy.asking import BackendQuery, ask
from rn_recorder_policy.command import read_demonstration
from rn_recorder_policy.diagnosis import KINDS, Diagnosis, diagnose
from rn_recorder_policy.name_mapping import NameMapping
from rn_recorder_runs.deployed import DeployedBackend
from roboneuron import ActionChunk, BackendSpec, Observation
from roboneuron.modules.inference.agreement import SpaceAgreement

VERSIONS = {"ee_delta": "v3.0", "joint_position": "v2.1", "joint_velocity": "v3.0"}
Check = Callable[..., Diagnosis]


def deployed(policy: KnowingPolicy) -> DeployedBackend:
    """The policy on the arm."""
    space, profile = SPACES[policy.kind], arm_profile()
    return DeployedBackend(
        backend=policy,
        spec=BackendSpec(
            name="knowing", summary="", target="", cameras=("primary",), needs_state=True
        ),
        profile=profile,
        cameras={"primary": profile.cameras[0]},
        agreement=SpaceAgreement(declared=space, executed=space, columns=tuple(range(space.size))),
    )


@pytest.fixture(scope="module")
def check(tmp_path_factory: pytest.TempPathFactory) -> Check:
    """Ask a policy for the frames of its data set, and compare."""
    folder = tmp_path_factory.mktemp("sets")

    def of(policy: KnowingPolicy, unit: str = "rad", in_degrees: bool = False) -> Diagnosis:
        path, version = folder / f"{policy.kind}-{unit}", VERSIONS[policy.kind]
        if not path.exists():
            write_dataset(path, policy.kind, version=version, unit=unit)
        demonstration = read_demonstration(path, 0 if version == "v2.1" else 1)
        question = BackendQuery(mapping=NameMapping(in_degrees=in_degrees), cameras={}, frames=40)
        return diagnose(ask(deployed(policy), demonstration, question).answers)

    return of


class DegreePolicy(KnowingPolicy):
    """It gets its state in degrees as well, and looks at the picture only."""

    def predict(self, observation: Observation) -> ActionChunk:
        """As for radians."""
        joints = observation.joints
        assert joints is not None
        position = np.hstack([np.radians(joints.position[:7]), joints.position[7:]])
        seen = Observation(
            frames=observation.frames,
            instruction=observation.instruction,
            joints=type(joints)(names=joints.names, position=position),
        )
        return super().predict(seen)


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("name", FAULTS)
def test_a_seeded_fault_is_named(check: Check, name: str) -> None:
    seeded = FAULTS[name]
    policy = (DegreePolicy if seeded.unit == "deg" else KnowingPolicy)(
        seeded.kind, seeded.fault, step_s=seeded.step_s
    )
    found = check(policy, seeded.unit).faults
    assert [fault.kind for fault in found] == [seeded.named], found
    keys = SPACES[seeded.kind].keys
    if seeded.channels is not None:
        assert set(found[0].channels) == {keys[c] for c in seeded.channels}


def test_faults_of_every_kind_are_seeded() -> None:
    assert len(FAULTS) >= 40
    assert {seeded.named for seeded in FAULTS.values()} == set(KINDS) - {"unexplained"}
    for kind in SPACES:
        assert sum(seeded.kind == kind for seeded in FAULTS.values()) >= 11


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("kind", SPACES)
@pytest.mark.parametrize(
    "own",
    [
        {},
        {"noise": 0.0},
        {"noise": 0.3},
        {"noise": 0.5},
        {"gain": 0.8},
        {"gain": 0.75, "noise": 0.2},
        {"horizon": 1},
        {"horizon": 1, "noise": 0.4},
        {"horizon": 16},
    ],
    ids=str,
)
def test_a_policy_that_is_wired_rightly_gives_no_alarm(
    check: Check, kind: str, own: dict[str, float]
) -> None:
    assert check(KnowingPolicy(kind, **own)).faults == ()


def test_a_data_set_in_degrees_agrees_when_it_is_said(check: Check) -> None:
    assert check(KnowingPolicy("joint_position"), "deg", in_degrees=True).faults == ()


def test_two_faults_are_both_named(check: Check) -> None:
    def both(asked) -> np.ndarray:
        rows = asked.rows()
        rows[:, :7] *= 180.0 / np.pi
        rows[:, 7] = 1.0 - rows[:, 7]
        return rows

    found = check(KnowingPolicy("joint_position", both)).faults
    assert {fault.kind for fault in found} == {"degrees", "gripper"}


@pytest.mark.parametrize("kind", SPACES)
def test_a_policy_that_knows_nothing_is_not_explained(check: Check, kind: str) -> None:
    def guess(asked) -> np.ndarray:
        spread = recorded(kind).std(axis=0)
        mean = recorded(kind).mean(axis=0)
        rows = mean + spread * np.random.default_rng(asked.row).normal(size=asked.error.shape)
        rows[:, -1] = asked.rows()[:, -1]
        return rows

    assert [fault.kind for fault in check(KnowingPolicy(kind, guess)).faults] == ["unexplained"]


def test_a_rate_that_one_row_cannot_show_is_told_as_declared(check: Check) -> None:
    (found,) = check(KnowingPolicy("joint_position", horizon=1, step_s=0.5 / RATE_HZ)).faults
    assert found.kind == "rate"
    assert "one row" in found.text


def test_rows_at_another_rate_agree_when_the_backend_says_so(check: Check) -> None:
    """Twice as many rows a second, each for its own moment."""

    def halves(asked) -> np.ndarray:
        return asked.rows(0.0, 0.5)

    policy = KnowingPolicy("joint_position", halves, step_s=0.5 / RATE_HZ)
    assert check(policy).faults == ()


def test_each_frame_is_asked_by_itself(tmp_path: Path) -> None:
    path = write_dataset(tmp_path / "set", "ee_delta")
    policy = KnowingPolicy("ee_delta")
    question = BackendQuery(mapping=NameMapping(), cameras={}, frames=12)
    asked = ask(deployed(policy), read_demonstration(path, 1), question)
    assert policy.resets == len(asked.answers.frames) == 12
    assert asked.answers.predicted.shape == (12, 8, 7)


@pytest.mark.parametrize("kind", SPACES)
def test_a_right_wiring_leaves_little_to_explain(check: Check, kind: str) -> None:
    assert check(KnowingPolicy(kind)).after.max() < 0.05
