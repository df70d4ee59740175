"""Number of participants on one host that discover each other, with one node per participant, as in
modules.

    python benchmarks/bench_discovery.py [--participants 24 48] [--probed 32 96]

With discovery in the range LOCALHOST a participant announces itself to the number of ports of this
host set in the Fast DDS profile (`maxInitialPeersRange`, which RoboNeuron's profile takes from
ROBONEURON_PARTICIPANTS). Two participants with higher numbers than that never discover each other.
A row shows the fraction of all pairs that have discovered each other, and the CPU load (in cores)
of all of them while they only announce themselves.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

NODES_A_PROCESS = 8
BEGIN_S, END_S = 120.0, 180.0
NODES = """
import json, sys, time
import rclpy
from rclpy.node import Node

first, count, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
nodes = []
for number in range(first, first + count):
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes.append(Node(f"p{number}", context=context, enable_rosout=False, start_parameter_services=False))
print("up", flush=True)
sys.stdin.readline()
began_s = time.process_time()
time.sleep(seconds)
used_s = time.process_time() - began_s
found = {node.get_name(): [n for n in node.get_node_names() if n.startswith("p")] for node in nodes}
print(json.dumps({"used_s": used_s, "found": found}), flush=True)
for node in nodes:
    node.destroy_node()
    rclpy.shutdown(context=node.context)
"""  # noqa: E501


def measure(participants: int, probed: int, seconds: float) -> tuple[float, float]:
    """Fraction of discovered pairs, and the total CPU load in cores."""
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "ROBONEURON_PARTICIPANTS": str(probed),
    }
    processes = []
    with ExitStack() as stack:
        for first in range(0, participants, NODES_A_PROCESS):
            count = min(NODES_A_PROCESS, participants - first)
            process = subprocess.Popen(
                [sys.executable, "-c", NODES, str(first), str(count), str(seconds)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
                text=True,
            )
            stack.callback(process.kill)
            processes.append(process)
        for process in processes:
            assert process.stdout is not None
            late = threading.Timer(BEGIN_S, process.kill)
            late.start()
            stack.callback(late.cancel)
            if process.stdout.readline() != "up\n":
                raise SystemExit("A process with nodes did not come up.")
        answers = []
        time.sleep(2.0)  # the last participants announce themselves
        for process in processes:
            assert process.stdin is not None
            process.stdin.write("\n")
            process.stdin.flush()
        for process in processes:
            out, _ = process.communicate(timeout=seconds + END_S)
            answers.append(json.loads(out))
    found = {name: set(names) for answer in answers for name, names in answer["found"].items()}
    pairs = sum(len(names - {name}) for name, names in found.items())
    return pairs / (participants * (participants - 1)), sum(
        answer["used_s"] for answer in answers
    ) / seconds


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--participants", type=int, nargs="+", default=[24, 48])
    parser.add_argument("--probed", type=int, nargs="+", default=[32, 96])
    parser.add_argument("--seconds", type=float, default=10.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        prepare_environment(Path(scratch))
        print(
            "| participants | probed | pairs that found each other | share of a core "
            "|\n|---|---|---|---|"
        )
        for participants in arguments.participants:
            for probed in arguments.probed:
                share, used = measure(participants, probed, arguments.seconds)
                print(f"| {participants} | {probed} | {share:.1%} | {used:.2f} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
