"""Age of an image when a browser shows it, and time until an arm stands after a click on the
emergency stop.

    .venv/bin/python benchmarks/bench_view.py [--seconds 20] [--clicks 12]

Images of 640 x 480 are published at 10 Hz on a ROS topic, each with another grey level; the page,
in a real browser, notes the time when its first image changes. Then the stop is clicked on the page
of a server whose simulated FR3 turns its wrist, and measured at the joints (`view_stops.py`). All
clocks are this machine's.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "plugins" / "rn-view" / "tests"), str(Path(__file__).parent)]

from view_fakes import admission  # noqa: E402
from view_stops import Stop, measure_stops  # noqa: E402

from rn_testing.domain import free_ros_domain  # noqa: E402
from rn_view.options import ViewOptions  # noqa: E402
from rn_view.web.view_server import ViewServer  # noqa: E402
from rn_view_attached.source import AttachedSource, ViewNode  # noqa: E402
from roboneuron.config import load_config  # noqa: E402
from roboneuron.plugins.discovery import discover  # noqa: E402
from roboneuron.ros.environment import prepare_environment  # noqa: E402

RATE_HZ, LEVELS = 10.0, 8
WATCH = """() => {
  window.changes = [];
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = 1;
  const pen = canvas.getContext('2d', {willReadFrequently: true});
  let last = -1;
  const look = () => {
    const image = document.querySelector('img');
    if (image && image.complete && image.naturalWidth) {
      pen.drawImage(image, 0, 0, 1, 1);
      const level = Math.round((pen.getImageData(0, 0, 1, 1).data[0] - 20) / 28);
      if (level !== last) { window.changes.push([Date.now() / 1000, level]); last = level; }
    }
    requestAnimationFrame(look);
  };
  look();
}"""
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


def measure_pictures(browser: Any, folder: Path, seconds: float) -> tuple[int, list[float]]:
    """Number of sent images, and the age of each when shown [ms], youngest first."""
    import numpy as np

    config = load_config(None)
    graph = ViewNode(folder)
    graph.open()
    source = AttachedSource(config, discover(), folder, graph)
    from sensor_msgs.msg import Image

    from roboneuron.ros.link import RosLink
    from roboneuron.ros.qos import STATUS

    camera = RosLink("bench_camera")
    camera.open()
    publish = camera.advertise(Image, f"/{config.namespace}/camera/front/image", STATUS)
    options = ViewOptions(enabled=True, port=0, image_hz=30.0)
    viewer = ViewServer(options, source, admission(options), None)
    viewer.open()
    messages = []
    for level in range(LEVELS):
        message = Image(width=640, height=480, step=1920, encoding="rgb8")
        message.data = np.full(640 * 480 * 3, 20 + 28 * level, dtype=np.uint8).tobytes()
        messages.append(message)
    sent: list[tuple[float, int]] = []
    page = browser.new_page(viewport={"width": 700, "height": 500})
    page.set_default_timeout(180_000)
    page.goto(viewer.url)
    page.get_by_text("Instruction:").wait_for(timeout=180_000)
    page.evaluate(WATCH)
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        due_s = time.monotonic() + 1.0 / RATE_HZ
        level = len(sent) % LEVELS
        stamp_s = time.time()
        messages[level].header.stamp.sec, messages[level].header.stamp.nanosec = divmod(
            int(stamp_s * 1e9), 10**9
        )
        sent.append((stamp_s, level))
        publish(messages[level])
        time.sleep(max(0.0, due_s - time.monotonic()))
    time.sleep(2.0)
    changes = page.evaluate("() => window.changes")
    page.close()
    viewer.close()
    camera.close()
    graph.close()
    ages_ms = []
    for at_s, level in changes:
        before = [s for s, other in sent if other == level and s <= at_s]
        if before:
            ages_ms.append((at_s - before[-1]) * 1e3)
    return len(sent), sorted(ages_ms)


def table(title: str, rows: dict[str, list[float]], digits: int = 0) -> None:
    """Print median and worst of each row."""
    print(f"\n| {title} | median | worst |\n|---|---|---|")
    for name, values in rows.items():
        print(f"| {name} | {statistics.median(values):.{digits}f} | {max(values):.{digits}f} |")


def measure(seconds: float, clicks: int) -> int:
    """Print the tables; returns the exit status. Bounds that the machine cannot reach are reported
    as missed.
    """
    chromium = shutil.which("chromium")
    if chromium is None:
        print("missed: not measured, there is no chromium (Debian: apt-get install chromium)")
        return 0
    from playwright.sync_api import sync_playwright

    os.environ.update(ROS_DOMAIN_ID=str(free_ros_domain()), ROBONEURON_RECORDER="off")
    prepare_environment(Path(tempfile.mkdtemp()))
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as name:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        sent, ages_ms = measure_pictures(browser, Path(name), seconds)
        stops: list[Stop] = measure_stops(browser, Path(name), clicks) if clicks else []
        browser.close()
    load = os.getloadavg()[0]
    print(
        f"load of the machine {load:.1f} on {os.cpu_count()} cores; {sent} pictures sent, "
        f"{len(ages_ms)} shown"
    )
    if stops:
        speeds = [stop.speed_rad_s for stop in stops]
        rows = {
            "latch file": [stop.file_ms for stop in stops],
            "joints at rest": [stop.rest_ms for stop in stops],
        }
        print(f"{len(stops)} clicks on the stop at {min(speeds):.2f} to {max(speeds):.2f} rad/s")
        table("from the click to ... [ms]", rows)
        table("from the click on [rad]", {"way of the joint": [stop.way_rad for stop in stops]}, 3)
    if len(ages_ms) < sent / 2:
        print(f"missed: {len(ages_ms)} of {sent} pictures were drawn at a load of {load:.0f}")
        return 0
    table("from the source to pixels [ms]", {"each picture": ages_ms})
    print(f"95 % within {ages_ms[int(0.95 * (len(ages_ms) - 1))]:.0f} ms")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0, help="of pictures (default: 20)")
    parser.add_argument("--clicks", type=int, default=12, help="on the stop; 0: none (default: 12)")
    arguments = parser.parse_args()
    sys.exit(measure(arguments.seconds, arguments.clicks))
