"""Sources of a leader's motion: joint states on a ROS topic, or a page of the live view."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import TYPE_CHECKING, Protocol
from urllib.parse import urlsplit

import httpx2

from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    InvalidInputError,
    foreign,
    joints_from_message,
)
from roboneuron.command import environment

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

    from roboneuron.command import RosLink

_ASKED_S = 1.0 / 40.0
"""Period of requests to the page; shorter than lerobot's control period."""
_ANSWER_S = 0.4
"""Time after which a view counts as silent. Below the default `timeout_s`."""
_JSON = "application/json"


@dataclass(frozen=True, slots=True)
class Led:
    """The last state of a leader.

    Attributes:
        positions: by joint [rad or m]; empty before the first.
        at_s: arrival time [monotonic s]; 0 before the first.
        problem: why the positions cannot be used; empty if they can.
        silence: known cause of missing positions.
    """

    positions: Mapping[str, float] = field(default_factory=dict)
    at_s: float = 0.0
    problem: str = ""
    silence: str = ""


class Leader(Protocol):
    """A source of motion. Usable from any thread."""

    @property
    def name(self) -> str:
        """Description for use within a sentence: "on /leader/joint_states"."""
        ...

    def open(self) -> None:
        """Start listening; does not wait. Raises RoboNeuronError."""
        ...

    def newest(self, wait_s: float) -> Led:
        """The newest state, or a problem; waits at most `wait_s` [s] for the first one."""
        ...

    def close(self) -> None:
        """Stop listening."""
        ...


class TopicLeader:
    """Joint states of a leader arm, a program or another robot."""

    def __init__(self, topic: str) -> None:
        """Args:
        topic: absolute name, sensor_msgs/JointState.
        """
        self.name = f"on {topic}"
        self._topic = topic
        self._changed = threading.Condition()
        self._led = Led(silence="Does it publish joint states there, in the same ROS domain?")
        self._link: RosLink | None = None

    def open(self) -> None:
        """See Leader."""
        environment.prepare_environment()
        from sensor_msgs.msg import JointState  # heavy: needs the environment

        from roboneuron.command import RosLink  # likewise

        link = RosLink("lerobot_teleoperator")
        link.open()
        link.follow(JointState, self._topic, self._take)
        self._link = link

    def newest(self, wait_s: float) -> Led:
        """See Leader."""
        with self._changed:
            self._changed.wait_for(lambda: self._led.at_s > 0.0, wait_s)
            return self._led

    def close(self) -> None:
        """See Leader."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _take(self, message: JointState) -> None:
        problem, positions = "", dict[str, float]()
        try:
            joints = joints_from_message(message)
            positions = dict(zip(joints.names, joints.position.tolist(), strict=True))
        except InvalidInputError as error:
            problem = f"A state {self.name} is malformed: {error}"
        with self._changed:
            self._led = Led(positions, time.monotonic(), problem, self._led.silence)
            self._changed.notify_all()


class PageLeader:
    """A person who moves the sliders of a live view's page, read from `/lead` of its server."""

    def __init__(self, view: str, robot: str, token: str) -> None:
        """Args:
        view: address of the view, "http://127.0.0.1:8780". robot: namespace of the robot. token:
        one of [[http.tokens]]; empty for a view without tokens.

        Raises:
            ConfigurationError: the address is invalid.
        """
        parts = urlsplit(view)
        if parts.scheme != "http" or not parts.hostname:
            raise ConfigurationError(f"view is {view!r}, expected http://HOST:PORT.")
        self.name = f"on the page {view}"
        self._url = httpx2.URL(
            scheme="http",
            host=parts.hostname,
            port=parts.port,
            path="/lead",
            params={"robot": robot},
        )
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._changed = threading.Condition()
        self._led = Led(silence="The view has not answered yet.")
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """See Leader."""
        self._ending.clear()
        self._thread = threading.Thread(target=self._run, name="view-leader", daemon=True)
        self._thread.start()

    def newest(self, wait_s: float) -> Led:
        """See Leader."""
        with self._changed:
            self._changed.wait_for(lambda: self._led.at_s > 0.0 or bool(self._led.problem), wait_s)
            return self._led

    def close(self) -> None:
        """See Leader."""
        self._ending.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()

    def _run(self) -> None:
        # one connection per request, because the view closes it after its answer
        limits = httpx2.Limits(max_keepalive_connections=0)
        with httpx2.Client(
            headers=self._headers, timeout=_ANSWER_S, limits=limits, trust_env=False
        ) as client:
            while not self._ending.is_set():
                led = self._ask(client)
                with self._changed:
                    self._led = led
                    self._changed.notify_all()
                self._ending.wait(_ASKED_S)

    def _ask(self, client: httpx2.Client) -> Led:
        """Request the next state; if the view does not answer, the previous one is kept and
        ages.
        """
        before = self._led
        try:
            status, answer = self._get(client)
        except (httpx2.HTTPError, ForeignDataError) as error:
            return Led(before.positions, before.at_s, "", f"The view does not answer: {error}.")
        text = str(answer.get("text", "")).rstrip(".")
        if status == HTTPStatus.OK:
            try:
                positions = foreign.named_numbers(answer.get("positions"), "positions", 256)
            except ForeignDataError:
                return Led(problem=f"{self.name} is no live view of RoboNeuron.")
            return Led(positions, time.monotonic())
        if status == HTTPStatus.CONFLICT:
            return Led(before.positions, before.at_s, "", f"{text}.")
        return Led(problem=f"The leader {self.name} was refused: {text or status}.")

    def _get(self, client: httpx2.Client) -> tuple[int, dict[str, object]]:
        response = client.get(self._url)
        if response.headers.get("Content-Type") != _JSON:
            return response.status_code, {}
        return response.status_code, foreign.table(
            foreign.decode_json(response.content, "the answer"), "the answer"
        )
