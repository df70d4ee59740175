"""Take the pictures of docs/view.md: one episode of the servo policy, stepped at the page's own pace.

    .venv/bin/python tools/view_screenshots.py docs/assets

Simulation, policy, controller and limits are those of `roboneuron eval`; only the processes between them are left
out, so that a machine that draws the page with its processor shows the same as one that does not.
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import numpy as np
from geometry_msgs.msg import Point, PoseStamped, Quaternion
from playwright.sync_api import Browser, sync_playwright
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "plugins" / "rn-view" / "tests"))

from view_fakes import FakeOperator, FakeSource, admission  # noqa: E402

from rn_eval.plan import EvalPlan  # noqa: E402
from rn_eval.policy import load_backend  # noqa: E402
from rn_eval.runner import Runner  # noqa: E402
from rn_view.options import ViewOptions  # noqa: E402
from rn_view.source import ModuleRow, Snapshot  # noqa: E402
from rn_view.viewer import Viewer  # noqa: E402
from roboneuron.config import load_config  # noqa: E402
from roboneuron.plugins.discovery import discover  # noqa: E402

SEED, PLAY_S, ACTION_S = 10_002, 5.0, 0.1
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Episode(FakeSource):
    """A source that an episode feeds, as the topics of the robot would."""

    def __init__(self) -> None:
        super().__init__()
        plan = EvalPlan(config=load_config(None).model_dump(mode="json"), suite="cubes", backend="servo", episodes=1)
        runner = Runner(plan)
        self.setup = runner._setup
        self.episode = runner._suite.episodes(1, SEED)[0]
        self.scene = runner._suite.open(self.episode, self.setup)
        self.policy = load_backend(plan, discover(), "")
        self.took_ms: list[float] = []
        self.last: list[tuple[str, object]] = []
        self.happenings.add("tool", "start_robot(): done, 2.05 s")
        for kind in ("perception", "control", "inference"):
            self.happenings.add("tool", f"start_{kind}(): done")
        self.happenings.add("tool", f'set_instruction(instruction="{self.episode.instruction}"): done')

    def config(self):
        return self.setup.config

    def profile(self):
        return self.setup.profile

    def snapshot(self) -> Snapshot:
        took = float(np.median(self.took_ms)) if self.took_ms else None
        rows = (
            ModuleRow(kind="robot", health="ok", chosen="fr3"),
            ModuleRow(kind="perception", health="ok", chosen="fr3-sim-camera", rate_hz=1.0 / ACTION_S),
            ModuleRow(kind="inference", health="ok", chosen="servo", rate_hz=1.0 / ACTION_S, latency_ms=took),
            ModuleRow(kind="control", health="ok", chosen="urdf", rate_hz=1.0 / ACTION_S),
        )
        return Snapshot(modules=rows, instruction=self.episode.instruction)

    def play(self) -> None:
        """Step the episode, and tell the page after each action."""
        ticks = round(ACTION_S / self.scene.tick_s)
        for step in range(round(PLAY_S / ACTION_S)):
            now_s = step * ACTION_S
            observation = self.scene.observe(round(now_s * 1e9) + 1)
            begun_s = time.monotonic()
            action = self.policy.predict(observation).actions[0]
            self.took_ms.append((time.monotonic() - begun_s) * 1e3)
            self.scene.act(np.asarray(action, dtype=np.float64), now_s)
            for _ in range(3):
                self.scene.advance(ticks // 3)
                self._tell(observation, action)
                time.sleep(ACTION_S / 3)

    def repeat(self) -> None:
        """Tell the last of everything again, for a page that has come since."""
        for topic, message in self.last:
            self.send(topic, message)

    def _tell(self, observation, action) -> None:
        sample = self.scene._joints(0)
        pose = self.setup.controller.forward(sample)
        x, y, z, w = map(float, pose.quaternion_xyzw)
        tcp = PoseStamped()
        tcp.pose.position = Point(**dict(zip("xyz", map(float, pose.position_m), strict=True)))
        tcp.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
        self.last = [
            ("joint_states", JointState(name=list(sample.names), position=[float(v) for v in sample.position])),
            ("ee_pose", tcp),
            ("action", Float64MultiArray(data=[float(v) for v in action])),
        ]
        for frame in observation.frames.values():
            height, width = frame.image.shape[:2]
            message = Image(width=width, height=height, step=3 * width, encoding="rgb8", data=frame.image.tobytes())
            self.last.append((f"camera/{frame.camera}/image", message))
        self.repeat()


def shoot(browser: Browser, episode: Episode, url: str, path: Path, *, width: int, height: int, play: bool) -> None:
    """One picture of the page."""
    page = browser.new_context(viewport={"width": width, "height": height}).new_page()
    page.set_default_timeout(300_000)
    page.goto(url)
    page.get_by_text("Instruction:").wait_for()
    if play:
        episode.play()
    deadline_s = time.monotonic() + 30.0
    while time.monotonic() < deadline_s:
        episode.repeat()
        notices = page.locator(".mantine-Notification-closeButton")
        if notices.count():
            notices.first.click(force=True)
        page.wait_for_timeout(1000)
    page.screenshot(path=path, type="jpeg", quality=82)
    page.context.close()


def main() -> int:
    """Take both pictures."""
    folder = Path(sys.argv[1])
    episode = Episode()
    options = ViewOptions(enabled=True, port=0)
    viewer = Viewer(options, episode, admission(options), FakeOperator())
    viewer.open()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        shoot(browser, episode, viewer.url, folder / "view-live.jpg", width=1280, height=760, play=True)
        shoot(browser, episode, viewer.url, folder / "view-phone.jpg", width=412, height=840, play=False)
        browser.close()
    viewer.close()
    episode.scene.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
