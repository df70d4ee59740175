"""`make record-demos`: a demonstration in simulation, its data set, and its replay by the policy
that made it.
"""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from recorder_expectations import expected_episode

from rn_recorder_runs.command import Runs
from roboneuron import ConfigurationError

ROOT = Path(__file__).parents[3]


@pytest.mark.timeout(400)
def test_a_demonstration_is_recorded_exported_and_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = [sys.executable, str(ROOT / "examples" / "record_demos.py")]
    words = ["-n", "1", "--image-px", "160", "--codec", "h264", "--out", str(tmp_path)]
    done = subprocess.run(
        [*script, *words], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr + done.stdout
    wanted = expected_episode(tmp_path / "runs/recordings/demo-00000/part-0001.mcap")
    assert len(wanted["action"]) > 20
    rows = pq.read_table(tmp_path / "lerobot/data/chunk-000/file-000.parquet").to_pydict()
    np.testing.assert_array_equal(rows["roboneuron.action"], wanted["action"])
    np.testing.assert_array_equal(rows["observation.state"], wanted["state"].astype(np.float32))
    assert rows["roboneuron.sent_ns"] == wanted["sent_ns"].tolist()
    assert rows["roboneuron.seen_ns"] == wanted["image_ns"].tolist()

    parser = ArgumentParser()
    Runs().configure(parser)
    replay = [
        "--directory",
        str(tmp_path / "runs"),
        "replay",
        "demo-00000",
        "--out",
        str(tmp_path / "compared"),
    ]
    status = Runs().run(parser.parse_args(replay))  # the tolerance is 1e-9
    assert status == 0, capsys.readouterr().out
    told = json.loads((tmp_path / "compared/comparison.json").read_text())
    assert told["first_divergence"] is None
    # the option arrives
    assert Runs().run(parser.parse_args([*replay, "--option", "servo.gain=0.01"])) == 1
    with pytest.raises(
        ConfigurationError, match=r"names 'torch', which is not used here.*Used are: servo"
    ):
        Runs().run(parser.parse_args([*replay, "--option", "torch.device=cpu"]))
