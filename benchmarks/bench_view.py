"""How old a picture is when a browser shows it, and how soon a click on the emergency stop reaches the latch.

    .venv/bin/python benchmarks/bench_view.py [--seconds 20]

Pictures of 640 x 480 are published at 10 Hz on a ROS topic, each of another grey level; the page, in a real browser,
notes when its first picture changes. All clocks are this machine's.
The stop is measured from the click to the emergency stop's file.
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

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "plugins" / "rn-view" / "tests"))

from view_fakes import admission  # noqa: E402

from rn_testing.domain import free_ros_domain  # noqa: E402
from rn_view.options import ViewOptions  # noqa: E402
from rn_view.viewer import Viewer  # noqa: E402
from rn_view_attached.source import AttachedSource  # noqa: E402
from roboneuron.config import load_config  # noqa: E402
from roboneuron.gate.estop import FILE_NAME  # noqa: E402
from roboneuron.plugins.discovery import discover  # noqa: E402

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


def measure(seconds: float) -> int:
    """Print the tables; returns the exit status."""
    chromium = shutil.which("chromium")
    if chromium is None:
        print("missed: not measured, there is no chromium (Debian: apt-get install chromium)")
        return 0
    import numpy as np
    from playwright.sync_api import sync_playwright

    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    state = Path(tempfile.mkdtemp())
    config = load_config(None)
    source = AttachedSource(config, discover(), state)
    source.open()
    from sensor_msgs.msg import Image

    from roboneuron.ros.link import RosLink
    from roboneuron.ros.qos import STATUS

    camera = RosLink("bench_camera")
    camera.open()
    publish = camera.advertise(Image, f"/{config.namespace}/camera/front/image", STATUS)
    options = ViewOptions(enabled=True, port=0, image_hz=30.0)
    viewer = Viewer(options, source, admission(options), None)
    viewer.open()
    messages = []
    for level in range(LEVELS):
        message = Image(width=640, height=480, step=1920, encoding="rgb8")
        message.data = np.full(640 * 480 * 3, 20 + 28 * level, dtype=np.uint8).tobytes()
        messages.append(message)
    sent: list[tuple[float, int]] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
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
            messages[level].header.stamp.sec, messages[level].header.stamp.nanosec = divmod(int(stamp_s * 1e9), 10**9)
            sent.append((stamp_s, level))
            publish(messages[level])
            time.sleep(max(0.0, due_s - time.monotonic()))
        time.sleep(2.0)
        changes = page.evaluate("() => window.changes")
        begun_s = time.time()
        page.get_by_text("EMERGENCY STOP").first.click(force=True)
        deadline_s = time.time() + 30.0
        while not (state / FILE_NAME).exists() and time.time() < deadline_s:
            time.sleep(0.001)
        stop_ms = ((state / FILE_NAME).stat().st_mtime - begun_s) * 1e3
        browser.close()
    viewer.close()
    camera.close()
    source.close()
    ages_ms = []
    for at_s, level in changes:
        before = [s for s, other in sent if other == level and s <= at_s]
        if before:
            ages_ms.append((at_s - before[-1]) * 1e3)
    load = os.getloadavg()[0]
    ages_ms.sort()
    if len(ages_ms) < len(sent) / 2:
        print(f"missed: {len(ages_ms)} of {len(sent)} pictures were drawn at a load of {load:.0f}")
        return 0
    print(f"load of the machine {load:.1f} on {os.cpu_count()} cores; {len(sent)} pictures sent, {len(ages_ms)} shown")
    print("| source to pixels | ms |\n|---|---|")
    print(f"| median | {statistics.median(ages_ms):.0f} |")
    print(f"| 95 % | {ages_ms[int(0.95 * (len(ages_ms) - 1))]:.0f} |")
    print(f"| click on the stop to its file | {stop_ms:.0f} |")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    sys.exit(measure(parser.parse_args().seconds))
