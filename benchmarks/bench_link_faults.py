"""Faults of the link between a moving arm and the server of its policy, drawn at random and judged
one by one.

    python benchmarks/bench_link_faults.py [--trials 100] [--out out/bench/link-faults] [--judge]

Two machines (network namespaces): a simulated gantry with all its modules on one, `roboneuron
serve-policy` on the other, with the keys of `roboneuron link`. Half of the trials have a local
fallback. Half reach the server through a program with the server's own keys that spoils answers
(`link_liar`). Number of a trial: seed, cell and kind of fault. Each is a line of JSON in
OUT/trials.jsonl; a run that was ended goes on there. Needs root.

Each trial is judged: joints within their limits; no step beyond STEP_M and no speed beyond
SPEED_M_S; no row of an image older than configured, and none of an older image after a newer one;
where answers cease for long, the fallback moves the arm without a rest and gives back after three
good seconds, or the arm holds; the arm moves by its remote policy in the end. Exit status 1 when a
trial fails.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "plugins" / "rn-link" / "tests"))
sys.path.append(str(ROOT / "plugins" / "rn-backend-shared" / "tests"))
sys.path.append(str(Path(__file__).parent))

from fault_loop import STILL_M, environment, moving_cell  # noqa: E402
from link_machines import impossible, machines  # noqa: E402
from policy_servers import RunningServer, link_of, pair  # noqa: E402
from switch_plugin import named_by  # noqa: E402

from rn_standard.selection.requests import StartChosenInference  # noqa: E402
from rn_standard.tools_loop.instructing import give_instruction  # noqa: E402
from rn_testing.fakes.robot import gantry_profile  # noqa: E402
from rn_testing.spinning import spinning_node  # noqa: E402
from rn_testing.waiting import holds_within  # noqa: E402
from roboneuron import RoboNeuronError  # noqa: E402
from roboneuron.server.loop import ClosedLoop  # noqa: E402

OUT = Path("out/bench/link-faults")
LEDGER = "trials.jsonl"
RATE_HZ, ROWS, STEP_S = 30.0, 8, 0.05
IMAGE_AGE_S, TAIL_AGE_S = 0.5, 0.5 + ROWS * STEP_S
BUSY_S = 0.05
"""What a busy machine adds between the check of a row and its sending."""
STEP_M, SPEED_M_S = 0.006, 0.15
"""The policy asks for at most 3 mm in 50 ms."""
HOLDS_S, TAKES_OVER_S = 2.0, 2.0
BACK_S = 3.0
LONG_S = 2.5
"""Faults that last longer must be noticed by hold or fallback."""
STOOD_S = 0.6
AGAIN_S = 60.0
REMOTE, LOCAL = 1, 2
"""Tags of the policies."""
DIRECT = (
    "cable cut",
    "packets lost both ways",
    "packets lost one way",
    "server frozen",
    "model frozen",
    "server killed",
    "model killed",
    "keys swapped there",
    "keys swapped here",
)
SPOILT = (
    "replayed answer",
    "replayed before the answer",
    "answered twice",
    "garbage",
    "half an answer",
    "slow drip",
    "answers held back",
    "huge length",
    "swallowed",
    "handshake without a word",
    "garbage before the handshake",
)
HARMLESS = ("replayed before the answer", "answered twice")
"""The right answer comes too: what is spoilt must only not be executed."""
SHARED = """
[plugins.shared]
address = "gpu:7420"
timeout_s = 0.3
coding = "raw"
"""
"""Pixels number the images, which JPEG would change."""
POLICY = f"rows = {ROWS}\nstep_s = {STEP_S}\n"


class Trial(NamedTuple):
    """What is tried.

    Attributes:
        number: seed of all that is drawn.
        is_spoilt: the server is reached through `link_liar`.
        has_fallback: a second policy is there.
        kind: of the fault.
    """

    number: int
    is_spoilt: bool
    has_fallback: bool
    kind: str

    @classmethod
    def of(cls, number: int) -> Trial:
        """The trial of that number."""
        is_spoilt, has_fallback = number % 2 == 1, number // 2 % 2 == 1
        kinds = SPOILT if is_spoilt else DIRECT
        return cls(number, is_spoilt, has_fallback, kinds[number // 4 % len(kinds)])


class Row(NamedTuple):
    """An action as it was sent.

    Attributes:
        at_s: when, by the wall clock.
        age_s: of its image then.
        image, tag: which, and by which policy.
    """

    at_s: float
    age_s: float
    image: int
    tag: int


class Witness:
    """All actions with the age of what they answer, and the true joint; by the times at which they
    were sent and measured, so that a busy witness changes nothing.

    Args:
        node: in the robot's namespace.
    """

    def __init__(self, node: Any) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import Float64MultiArray

        self._sent: list[tuple[float, int, int]] = []
        self._joints: list[tuple[float, float]] = []
        self._stamps: dict[int, float] = {}
        qos = QoSProfile(depth=200)
        node.create_subscription(Image, "camera/front/image", self._on_image, qos)
        node.create_subscription(Float64MultiArray, "action", self._on_action, qos)
        node.create_subscription(JointState, "true_joint_states", self._on_joints, qos)

    def _on_image(self, message: Any) -> None:
        number = int.from_bytes(bytes(message.data[:4]), "little")
        self._stamps[number] = _seconds(message.header.stamp)

    def _on_joints(self, message: Any) -> None:
        self._joints.append((_seconds(message.header.stamp), float(message.position[0])))

    def _on_action(self, message: Any, info: dict[str, Any]) -> None:
        named = named_by(message.data[6])
        assert named is not None, "every policy here names its images"
        self._sent.append((int(info["source_timestamp"]) / 1e9, named[0], named[2]))

    def since(self, since_s: float, tag: int | None = None) -> list[Row]:
        """Actions after that time, of one policy or all."""
        return [
            Row(at_s, at_s - self._captured_s(image), image, by)
            for at_s, image, by in list(self._sent)
            if at_s >= since_s and tag in (None, by)
        ]

    def _captured_s(self, image: int) -> float:
        """When an image was captured; at the latest, where it was lost here."""
        if image in self._stamps:
            return self._stamps[image]
        later = [number for number in list(self._stamps) if number > image]
        return self._stamps[min(later)] if later else max(self._stamps.values())

    def sees(self) -> bool:
        """Whether images have come."""
        return bool(self._stamps)

    def joints(self, since_s: float) -> list[tuple[float, float]]:
        """Time and position [m] of the first joint after that time."""
        return [place for place in list(self._joints) if place[0] >= since_s]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec / 1e9)


class Site:
    """The other machine, its server, and what is between; used inside the robot's machine.

    Args:
        folder: with what the parent has made.
        facts: of the machines.
    """

    def __init__(self, folder: Path, facts: dict[str, Any], *, is_spoilt: bool) -> None:
        self.folder, self.facts, self.is_spoilt = folder, facts, is_spoilt
        site = folder / "server"
        site.mkdir(exist_ok=True)
        model = {
            "backend": "steady",
            "stateless": True,
            "options": {"rows": ROWS, "step_s": STEP_S},
        }
        listen = {"host": "0.0.0.0", "port": 7421 if is_spoilt else 7420}
        far = self

        class Far(RunningServer):
            def words(self) -> list[str]:
                return far.there(*super().words())

        self.server = Far(site, {"steady": model}, listen, Path(facts["gpu_state"]))
        self._liar: subprocess.Popen[bytes] | None = None

    def there(self, *words: str) -> list[str]:
        """The command line on the other machine."""
        return ["nsenter", "-t", str(self.facts["gpu_pid"]), "-n", "-m", *words]

    def start(self) -> None:
        """Start what is there."""
        self.server.start()
        if self.is_spoilt:
            script = str(Path(__file__).with_name("link_liar.py"))
            states = (self.facts["gpu_state"], self.facts["robot_state"], self.facts["gpu_address"])
            words = self.there(sys.executable, script, str(self.folder), *states)
            self._liar = subprocess.Popen(words)

    def close(self) -> None:
        """End it."""
        if self._liar is not None:
            self._liar.kill()
            self._liar.wait(10.0)
        self.server.end()

    def spoil(self, mode: str) -> None:
        """Tell the liar what to do; nothing with an empty mode."""
        fresh = self.folder / "liar.new"
        fresh.write_text(mode)
        fresh.replace(self.folder / "liar")

    def lied(self) -> int:
        """How often it has."""
        path = self.folder / "lied"
        return len(path.read_bytes()) if path.exists() else 0

    def _neighbour(self, words: Sequence[str], address: str, hardware: str) -> None:
        entry = [address, "lladdr", hardware, "dev", "cable", "nud", "permanent"]
        subprocess.run([*words, "ip", "neigh", "replace", *entry], check=True, timeout=60)

    def _lose(self, is_lost: bool, *, both: bool) -> None:
        wrong, facts = "02:00:00:00:00:99", self.facts
        here = wrong if is_lost else facts["gpu_hardware"]
        self._neighbour((), facts["gpu_address"], here)
        if both:
            there = wrong if is_lost else facts["robot_hardware"]
            self._neighbour(self.there(), facts["robot_address"], there)

    def _swap(self, whose: str) -> None:
        """Exchange the keys of a machine with those of a stranger."""
        own = link_of(Path(self.facts[f"{whose}_state"]))
        other = link_of(self.folder / f"stranger-{whose}")
        spare = own.with_name("link.spare")
        own.replace(spare)
        other.replace(own)
        spare.replace(other)
        (own / "link.json").touch()

    @contextlib.contextmanager
    def fault(self, kind: str) -> Iterator[None]:
        """The fault, until the context ends."""
        if kind in SPOILT:
            self.spoil(kind)
            try:
                yield
            finally:
                self.spoil("")
            return
        begin, end = self._of(kind)
        begin()
        try:
            yield
        finally:
            end()

    def _of(self, kind: str) -> tuple[Callable[[], object], Callable[[], object]]:
        def cable(state: str) -> Callable[[], object]:
            words = ["ip", "link", "set", "cable", state]
            return lambda: subprocess.run(words, check=True, timeout=60)

        def send(pid: int, number: int) -> Callable[[], object]:
            return lambda: os.kill(pid, number)

        if kind == "cable cut":
            return cable("down"), cable("up")
        if kind.startswith("packets lost"):
            both = kind.endswith("both ways")
            return lambda: self._lose(True, both=both), lambda: self._lose(False, both=both)
        if kind.startswith("keys swapped"):
            whose = "gpu" if kind.endswith("there") else "robot"
            return lambda: self._swap(whose), lambda: self._swap(whose)
        if kind == "server killed":
            return self.server.kill, lambda: self.server.start(is_ready=False)
        model = int(self.server.status()["models"]["steady"]["pid"])
        if kind == "model killed":
            return send(model, signal.SIGKILL), lambda: None
        pid = self.server.pid if kind == "server frozen" else model
        return send(pid, signal.SIGSTOP), send(pid, signal.SIGCONT)


class Judge:
    """Watches one trial.

    Args:
        witness: of actions and the joint.
        instruct: asks for motion anew where the inference module needs that; returns why, or an
            empty text.
    """

    def __init__(self, witness: Witness, instruct: Callable[[], str], trial: Trial) -> None:
        self._witness, self._instruct, self._trial = witness, instruct, trial

    def goes_on(self) -> bool:
        """The arm moves by its remote policy, and by nothing else."""
        if not self._witness.sees():
            return False
        since_s = time.time() - 0.5
        recent = self._witness.since(since_s)
        places = [x for _, x in self._witness.joints(since_s)]
        is_remote = len(recent) > 3 and all(row.tag == REMOTE for row in recent)
        return is_remote and max(places, default=0.0) - min(places, default=0.0) > STILL_M

    def run(self, site: Site) -> dict[str, Any]:
        """Let it happen, and judge it."""
        trial, drawn = self._trial, random.Random(self._trial.number)
        told: dict[str, Any] = {**trial._asdict(), "wrong": []}
        if not self._comes_back()[0]:
            return {**told, "wrong": ["it did not go on before the fault"]}
        time.sleep(drawn.uniform(0.0, 1.0))
        lies, fault_s = site.lied(), time.time()
        lasts_s = drawn.choice((drawn.uniform(0.2, 1.0), drawn.uniform(LONG_S, 4.0)))
        with site.fault(trial.kind):
            time.sleep(lasts_s)
            end_s = time.time()
        time.sleep(0.8)  # what follows may begin a moment later
        wrong = told["wrong"]
        is_back, told["stopped"] = self._comes_back()
        if not is_back:
            wrong.append("it did not go on by its remote policy")
        told |= {"fault_s": round(end_s - fault_s, 2), "back_s": round(time.time() - end_s, 2)}
        told["load"] = round(os.getloadavg()[0], 1)
        if trial.is_spoilt and site.lied() == lies and "handshake" not in trial.kind:
            wrong.append("nothing was spoilt")
        wrong += self._motion(fault_s, told)
        wrong += self._ages(fault_s, told)
        if not told["stopped"]:
            wrong += self._places(fault_s, end_s, told)
        return told

    def _comes_back(self) -> tuple[bool, str]:
        """Whether the arm moves by its remote policy within AGAIN_S, and what has stopped it for
        good before: a server that is silent, as on a busy machine.
        """
        end_s, why = time.monotonic() + AGAIN_S, ""
        while not holds_within(self.goes_on, 2.0):
            why = self._instruct() or why
            if time.monotonic() > end_s:
                return False, why
        return True, why

    def _motion(self, fault_s: float, told: dict[str, Any]) -> list[str]:
        """Whether the joint kept its bounds; how long it stood is kept in `told`."""
        places, wrong = self._witness.joints(fault_s - 1.0), []
        limits = gantry_profile().limits
        assert limits is not None
        if not all(limits.lower[0] <= x <= limits.upper[0] for _, x in places):
            wrong.append("a joint left its limits")
        steps = [abs(after[1] - before[1]) for before, after in pairwise(places)]
        told["step_mm"] = round(max(steps, default=0.0) * 1e3, 2)
        if told["step_mm"] > STEP_M * 1e3:
            wrong.append("the arm jumped")
        moved_s, stood_s, first, speed_m_s = fault_s, 0.0, 0, 0.0
        for (at_s, x), step_m in zip(places[1:], steps, strict=True):
            if step_m > STILL_M:
                stood_s, moved_s = max(stood_s, at_s - max(moved_s, fault_s)), at_s
            while places[first][0] < at_s - 0.2:
                first += 1
            since_s = at_s - places[first][0]
            if since_s > 0.1:
                speed_m_s = max(speed_m_s, abs(x - places[first][1]) / since_s)
        told |= {"stood_s": round(stood_s, 2), "speed_m_s": round(speed_m_s, 3)}
        if speed_m_s > SPEED_M_S:
            wrong.append("the arm was too fast")
        return wrong

    def _ages(self, since_s: float, told: dict[str, Any]) -> list[str]:
        """No row of an image that is too old, or older than that of a row before."""
        wrong, newest = [], {REMOTE: 0, LOCAL: 0}
        rows = self._witness.since(since_s - 1.0)
        told["rows"] = len(rows)
        told["oldest_s"] = round(max((row.age_s for row in rows), default=0.0), 3)
        for row in rows:
            is_first = row.image > newest[row.tag]
            if row.image < newest[row.tag]:
                wrong.append(f"image {row.image} after {newest[row.tag]}")
            newest[row.tag] = max(newest[row.tag], row.image)
            if row.age_s > (IMAGE_AGE_S if is_first else TAIL_AGE_S) + BUSY_S:
                wrong.append(f"a row of an image of {row.age_s:.2f} s")
        return wrong[:5]

    def _places(self, fault_s: float, end_s: float, told: dict[str, Any]) -> list[str]:
        """Who moved the arm when."""
        trial, wrong = self._trial, []
        local = self._witness.since(fault_s, LOCAL)
        told["took_over"] = bool(local)
        answers_ceased = trial.kind not in HARMLESS and end_s - fault_s > LONG_S
        if trial.kind == "model killed":  # it is back within a second or two
            answers_ceased = False
        if not trial.has_fallback:
            late = [r for r in self._witness.since(fault_s + HOLDS_S) if r.at_s < end_s]
            if answers_ceased and late:
                wrong.append("it moved on without answers")
            if local:
                wrong.append("a fallback acted that is not there")
            return wrong
        if answers_ceased:
            if not local or local[0].at_s > fault_s + TAKES_OVER_S:
                wrong.append("the fallback did not take over")
            elif told["stood_s"] > STOOD_S:
                wrong.append("the arm stood although there is a fallback")
        if local:
            remote = self._witness.since(local[0].at_s, REMOTE)
            back = [row for row in remote if row.at_s > local[-1].at_s]
            told["back_after_s"] = round(back[0].at_s - local[0].at_s, 2) if back else None
            if back and back[0].at_s - local[0].at_s < BACK_S - BUSY_S:
                wrong.append("it gave back before three good seconds")
            stray = [row for row in remote if row.at_s < local[-1].at_s and row.at_s > fault_s]
            if back and len(stray) and stray[-1].at_s - local[0].at_s < BACK_S - BUSY_S:
                wrong.append("late rows of the remote policy were executed")
        return wrong


def instruct(loop: ClosedLoop) -> str:
    """Ask for motion anew after a stop that forbids it until somebody does; returns its reason."""
    view = loop.modules.view("inference")
    if view.phase != "running":
        with contextlib.suppress(RoboNeuronError):
            loop.start("inference", StartChosenInference(instruction="move on", options={}))
        return "the inference module had ended"
    report = view.report
    if report is None or not report.needs_start:
        return ""
    with contextlib.suppress(RoboNeuronError):  # asked again as long as nothing moves
        give_instruction(loop, "move on", 10.0)
    return report.needs_start


def work(folder: Path, numbers: Sequence[int], ledger: Path) -> None:
    """The trials of one cell, inside the robot's machine."""
    first = Trial.of(numbers[0])
    facts = json.loads((folder / "facts.json").read_text())
    more = {
        "backend": "shared",
        "inference": 'fallback = "steadier"' if first.has_fallback else "",
        "camera": SHARED,
        "policy": POLICY,
    }
    cell = folder / "cell"
    cell.mkdir(exist_ok=True)
    with environment(cell):  # the server finds the policy too
        site = Site(folder, facts, is_spoilt=first.is_spoilt)
        site.spoil("")
        site.start()
        try:
            with (
                moving_cell(cell, RATE_HZ, **more) as (loop, _),
                spinning_node("gantry") as node,
            ):
                seen = Witness(node)
                for number in numbers:
                    told = Judge(seen, partial(instruct, loop), Trial.of(number)).run(site)
                    with ledger.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(told) + "\n")
                    print(json.dumps(told), flush=True)
        finally:
            site.close()


def hardware_of(words: Sequence[str]) -> str:
    """Address of the Ethernet device of a machine."""
    shown = subprocess.run(
        [*words, "ip", "-json", "link", "show", "cable"],
        check=True,
        capture_output=True,
        timeout=60,
    )
    return str(json.loads(shown.stdout)[0]["address"])


def run_cell(numbers: Sequence[int], ledger: Path) -> None:
    """Make two machines, and let one of them do the trials."""
    folder = Path(tempfile.mkdtemp(prefix="rn-faults-"))
    try:
        with machines(folder, "robot", "gpu") as both:
            here, there = both["robot"], both["gpu"]
            pair(here.state, there.state, address=there.address)
            names = ("stranger-robot", "stranger-gpu")
            pair(folder / names[0], folder / names[1], address=there.address)
            facts = {
                "gpu_pid": there.pid,
                "gpu_state": str(there.state),
                "robot_state": str(here.state),
                "gpu_address": there.address,
                "robot_address": here.address,
                "gpu_hardware": hardware_of(there.inside()),
                "robot_hardware": hardware_of(here.inside()),
            }
            (folder / "facts.json").write_text(json.dumps(facts))
            words = [sys.executable, __file__, "--work", str(folder), str(ledger.resolve())]
            words += [str(number) for number in numbers]
            variables = {"XDG_STATE_HOME": str(here.state), "ROBONEURON_LINK": "off"}
            worker = subprocess.Popen(here.inside(*words), env={**os.environ, **variables})
            try:
                code = worker.wait(180.0 + 2.5 * AGAIN_S * len(numbers))
            finally:
                worker.send_signal(signal.SIGTERM)
                worker.wait(60.0)
        if code:
            print(f"The worker of {numbers} ended with {code}.", flush=True)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def read(ledger: Path) -> list[dict[str, Any]]:
    """All trials so far."""
    lines = ledger.read_text(encoding="utf-8").splitlines() if ledger.exists() else []
    return [json.loads(line) for line in lines]


def table(trials: Sequence[dict[str, Any]]) -> int:
    """Print what came of them; returns how many failed."""
    print("|fault|trials|fallback took over|longest rest with it s|back s|oldest image s|wrong|")
    print("|---" * 7 + "|")
    for kind in (*DIRECT, *SPOILT):
        own = [trial for trial in trials if trial["kind"] == kind]
        if not own:
            continue
        second = [trial for trial in own if trial["has_fallback"]]
        took = sum(trial.get("took_over", False) for trial in second)
        stood = max((trial.get("stood_s", 0.0) for trial in second), default=0.0)
        back = max(trial.get("back_s", 0.0) for trial in own)
        oldest = max(trial.get("oldest_s", 0.0) for trial in own)
        wrong = Counter(word for trial in own for word in trial["wrong"])
        said = "; ".join(f"{count} x {word}" for word, count in wrong.items()) or "-"
        print(
            f"|{kind}|{len(own)}|{took}/{len(second)}|{stood:.1f}|{back:.1f}|{oldest:.2f}|{said}|"
        )
    failed = sum(bool(trial["wrong"]) for trial in trials)
    speed = max((trial.get("speed_m_s", 0.0) for trial in trials), default=0.0)
    step = max((trial.get("step_mm", 0.0) for trial in trials), default=0.0)
    stopped = sum(bool(trial.get("stopped")) for trial in trials)
    print(f"{stopped} were stopped by the machine itself and instructed anew")
    print(f"{len(trials)} trials, {failed} failed; fastest {speed} m/s, largest step {step} mm")
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Do what is missing, and print all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=100, help="numbers 0 to this one")
    parser.add_argument("--share", type=int, default=9, help="trials of one cell")
    parser.add_argument("--only", nargs="+", type=int, help="these numbers alone")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--judge", action="store_true", help="only print what is there")
    parser.add_argument("--work", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers end with it
    if given.work:
        folder, ledger, *numbers = given.work
        work(Path(folder), [int(number) for number in numbers], Path(ledger))
        return 0
    given.out.mkdir(parents=True, exist_ok=True)
    ledger = given.out / LEDGER
    if not given.judge:
        if reason := impossible():
            sys.exit(f"It {reason}.")
        done = {trial["number"] for trial in read(ledger)}
        missing = [n for n in given.only or range(given.trials) if n not in done]
        for cell in range(4):
            own = [number for number in missing if number % 4 == cell]
            for begin in range(0, len(own), given.share):
                run_cell(own[begin : begin + given.share], ledger)
    return 1 if table(read(ledger)) else 0


if __name__ == "__main__":
    sys.exit(main())
