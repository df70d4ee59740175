"""How often a subscription of images hangs its process, beside senders that are killed.

    python benchmarks/image_hangs.py --reader reliable --load 30 --folder /tmp/hangs
    python benchmarks/image_hangs.py --reader best-effort --lossy --folder /tmp/hangs

Fast DDS (2.14.5, and its main branch) keeps a sample of which some fragments have arrived in two
lists of a reliable reader. When the sender cannot repeat the others, because its history of one
sample has moved on, it answers with a GAP, and `StatefulReader::processGapMsg` removes the sample
from one of the lists only. `take` then finds a released sample without a payload, cannot remove it,
and tries again for ever, with Python's interpreter lock held. A best-effort reader
(`StatelessReader`) collects fragments outside its history and ignores GAPs.

A child process makes subscriptions as `Host.subscribe` does, each until its first image or for half
a second; "lasting" makes one only. The parent watches it from outside, because a hanging child runs
no thread of its own. Publishers send images and are killed at random times. --lossy takes UDP with
small buffers instead of shared memory, and halts the child for moments, so that fragments are lost.
A child that computes for `HANGS_S` without a sign of life counts as a hang, and is ended.

Results are lines in FOLDER/results.jsonl; an interrupted run is resumed. Exit status 1 if there was
a hang.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from rare_faults import loaded

from rn_testing.domain import free_ros_domain

sys.path.pop(0)

HANGS_S = 15.0
"""A busy child gives a sign of life within a second or two."""
CPU_S = 0.5
"""A hang computes; a child that only waits for the processor does not use it this long."""
TOPIC = "/hangs/image"
HEIGHT, WIDTH, RATE_HZ = 720, 1280, 30.0
PUBLISHERS = 2
READERS = (
    "reliable",
    "reliable-beside",
    "reliable-deep-beside",
    "reliable-lasting",
    "best-effort",
    "best-effort-beside",
    "best-effort-lasting",
)
"""beside: another subscription of the process to the same topic lasts."""
LOSSY = """<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>lossy</transport_id>
      <type>UDPv4</type>
      <receiveBufferSize>65536</receiveBufferSize>
      <maxMessageSize>16384</maxMessageSize>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="lossy" is_default_profile="true">
    <rtps>
      <userTransports><transport_id>lossy</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
</profiles>
"""
PUBLISH = f"""
import time
from roboneuron.ros.environment import prepare_environment
prepare_environment()
from sensor_msgs.msg import Image
from roboneuron.ros.link import RosLink
from roboneuron.ros.qos import NEWEST
link = RosLink("sender")
link.open()
publish = link.advertise(Image, {TOPIC!r}, NEWEST)
image = Image(height={HEIGHT}, width={WIDTH}, step={3 * WIDTH}, encoding="rgb8")
image.data = bytes({3 * WIDTH * HEIGHT})
while True:
    publish(image)
    time.sleep({1.0 / RATE_HZ})
"""
SUBSCRIBE = f"""
import sys, threading, time
from roboneuron.ros.environment import prepare_environment
prepare_environment()
from rclpy.qos import QoSProfile, ReliabilityPolicy, HistoryPolicy
from sensor_msgs.msg import Image
from roboneuron.ros.link import RosLink
reader, number = sys.argv[1], int(sys.argv[2])
is_reliable = "reliable" in reader
reliability = ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT
depth = 5 if "deep" in reader else 1
qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability)
link = RosLink("reader")
link.open()
came = threading.Event()
if "beside" in reader:
    link.subscribe(Image, {TOPIC!r}, lambda message: None, qos)
if "lasting" in reader:
    link.subscribe(Image, {TOPIC!r}, lambda message: came.set(), qos)
for count in range(number):
    came.clear()
    end = (lambda: None) if "lasting" in reader else link.subscribe(
        Image, {TOPIC!r}, lambda message: came.set(), qos)
    got = came.wait(0.5)
    end()
    print(int(got), flush=True)
link.close()
"""


class Publishers:
    """Processes that send images; one of them is killed and started again now and then."""

    def __init__(self, environment: Mapping[str, str], seed: int) -> None:
        self._environment, self._draw = environment, random.Random(seed)
        self._running = [self._start() for _ in range(PUBLISHERS)]
        self._due_s = time.monotonic() + 3.0
        self.killed = 0

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-c", PUBLISH]
        return subprocess.Popen(command, env=self._environment, stderr=subprocess.DEVNULL)

    def look(self) -> None:
        """Kill one if it is time."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + self._draw.uniform(1.0, 4.0)
        number = self._draw.randrange(PUBLISHERS)
        self._running[number].kill()
        self._running[number].wait(10)
        self._running[number] = self._start()
        self.killed += 1

    def close(self) -> None:
        """End all of them."""
        for process in self._running:
            process.kill()
            process.wait(10)


def halt(pid: int, seconds: float) -> None:
    """Stop a process for a moment, as a busy machine does."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)


def used_s(pid: int) -> float:
    """Time that a process has computed [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def batch(
    reader: str,
    number: int,
    environment: Mapping[str, str],
    seed: int,
    end_s: float,
    halts: bool,
) -> dict[str, Any]:
    """One child with so many subscriptions, or until it hangs."""
    publishers = Publishers(environment, seed)
    command = [sys.executable, "-c", SUBSCRIBE, reader, str(number)]
    child = subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert child.stdout is not None
    draw = random.Random(seed)
    made = images = 0
    hang = False
    heard_s, busy_s = time.monotonic() + 10.0, 0.0
    try:
        while time.monotonic() < end_s:
            publishers.look()
            if halts:
                halt(child.pid, draw.uniform(0.02, 0.15))
            if select.select([child.stdout], [], [], draw.uniform(0.02, 0.2))[0]:
                line = child.stdout.readline()
                if not line:
                    break
                made, images = made + 1, images + int(line)
                heard_s, busy_s = time.monotonic(), used_s(child.pid)
            elif time.monotonic() - heard_s > HANGS_S:
                hang = used_s(child.pid) - busy_s > CPU_S
                break
    finally:
        child.kill()
        child.wait(10)
        publishers.close()
    return {
        "reader": reader,
        "subscriptions": made,
        "images": images,
        "killed": publishers.killed,
        "hang": hang,
    }


def main() -> int:
    """Run batches until there are enough subscriptions, and count the hangs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--reader", choices=READERS, default="reliable")
    parser.add_argument("--subscriptions", type=int, default=300)
    parser.add_argument("--load", type=int, default=0, help="busy processes beside it")
    parser.add_argument("--lossy", action="store_true", help="UDP with small buffers")
    parser.add_argument("--minutes", type=float, default=10.0, help="no batch begins later")
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    ledger = arguments.folder / "results.jsonl"
    kind = {"lossy": arguments.lossy, "load": arguments.load, "reader": arguments.reader}
    known = [json.loads(line) for line in ledger.open()] if ledger.exists() else []
    done = [line for line in known if kind.items() <= line.items()]
    end_s = time.monotonic() + arguments.minutes * 60
    with tempfile.TemporaryDirectory() as scratch, loaded(arguments.load):
        environment = os.environ | {
            "ROS_DOMAIN_ID": str(free_ros_domain()),
            "ROS_LOG_DIR": scratch,
        }
        if arguments.lossy:
            profile = Path(scratch) / "lossy.xml"
            profile.write_text(LOSSY)
            environment["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
        while (made := sum(line["subscriptions"] for line in done)) < arguments.subscriptions:
            if time.monotonic() > end_s:
                break
            left = min(100, arguments.subscriptions - made)
            found = batch(
                arguments.reader, left, environment, len(done), end_s, halts=arguments.lossy
            )
            done.append(kind | found)
            with ledger.open("a") as file:
                file.write(json.dumps(done[-1]) + "\n")
            print(json.dumps(done[-1]), flush=True)
    hangs = sum(line["hang"] for line in done)
    images = sum(line["images"] for line in done)
    print(f"{kind}: {made} subscriptions, {images} with an image, {hangs} hangs")
    return int(bool(hangs))


if __name__ == "__main__":
    sys.exit(main())
