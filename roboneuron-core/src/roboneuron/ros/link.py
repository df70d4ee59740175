"""The server's ROS node: one context, one node, one executor thread; usable from any thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future as Answer
from concurrent.futures import wait
from contextlib import suppress
from typing import Any, TypeAlias, TypeVar

import rclpy
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future

from roboneuron.errors import InternalError
from roboneuron.ros.executor import TolerantExecutor, created
from roboneuron.ros.qos import is_large, large_qos, requested_qos, usual_qos

log = logging.getLogger(__name__)
M = TypeVar("M")
T = TypeVar("T")
Call: TypeAlias = Future
"""A pending service call; usable from any thread. `cancel` discards it: rclpy would keep the
request for an answer that never comes.
"""
_UNSENT = (rclpy_implementation.RCLError, InvalidHandle)
"""Exceptions of publishing after the context was closed."""
_TASK_TIMEOUT_S = 10.0
"""Timeout of creating an entity: it takes milliseconds, or seconds on an overloaded machine; after
that the ROS thread hangs.
"""
_LOOK_S = 0.1
"""Period of checking, while waiting for the ROS thread, that it still runs."""
_LEAVE_S = 2.0
"""Timeout for the end of the executor and of its thread: a hanging callback must not block the
server's exit.
"""


class _Followed:
    """A subscription that is made again when a publisher comes that offers less than the others;
    used on the executor's thread.
    """

    def __init__(
        self,
        make: Callable[[Callable[[], None]], Callable[[], None]],
        post: Callable[[Callable[[], None]], None],
    ) -> None:
        """Args:
        make: subscribes by the publishers of now; gets what to call when one does not match, and
            returns what ends the subscription.
        post: has the executor call a function later: a subscription cannot end in its own event.
        """
        self._make, self._post = make, post
        self._end: Callable[[], None] | None = None

    def begin(self) -> None:
        self._end = self._make(lambda: self._post(self._renew))

    def finish(self) -> None:
        end, self._end = self._end, None
        if end is not None:
            end()

    def _renew(self) -> None:
        if self._end is None:
            return
        try:
            self.finish()
            self.begin()
        # a task of the executor has nobody to tell
        except Exception:
            log.exception("A subscription cannot be renewed.")


class RosLink:
    """A node of the server.

    Entities are created and destroyed on the executor's thread, which also runs callbacks;
    callbacks must return quickly. rclpy builds its wait set from the node's entities: destroying
    one on another thread would leave a dead handle in it.
    """

    def __init__(self, node_name: str, on_lost: Callable[[], object] = lambda: None) -> None:
        """Args:
        node_name: name in the root namespace.
        on_lost: called on the executor's thread when that ends although the link is open; nothing
            is received or created any more.
        """
        self._node_name = node_name
        self._on_lost = on_lost
        self._context: Any = None
        self._node: Any = None
        self._executor: Any = None
        self._thread: threading.Thread | None = None
        # written on the executor's thread only, so that nobody waits for it with a lock held
        self._clients: dict[tuple[type, str], Client] = {}
        # set when the task has ended for which somebody waited too long
        self._late: threading.Event | None = None

    def open(self) -> None:
        """Join the graph (about 0.4 s); `roboneuron.ros.environment.prepare_environment` must have
        run.
        """
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = Node(
            self._node_name,
            context=self._context,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor = TolerantExecutor(_log_failure, context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="ros-link", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the graph; idempotent."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._executor.shutdown(timeout_sec=_LEAVE_S)
        thread.join(timeout=_LEAVE_S)
        self._clients.clear()
        # an action client would keep the node on the graph
        for waitable in tuple(self._node.waitables):
            if isinstance(waitable, ActionClient):
                waitable.destroy()
        self._node.destroy_node()
        self._context.try_shutdown()

    @property
    def node(self) -> Node:
        """The node; create and destroy entities with `on_executor`.

        Raises:
            InternalError: the link is not open.
        """
        if self._node is None:
            raise InternalError("The ROS link is not open.")
        return self._node

    def on_executor(self, task: Callable[[], T]) -> T:
        """Run `task` on the executor's thread; return its result or raise its exception, whatever
        that is. Callable from any thread.

        Raises:
            InternalError: the link is not open, or its thread hangs or has ended; the task is not
                begun afterwards.
        """
        thread = self._thread
        if thread is None:
            raise InternalError("The ROS link is not open.")
        if thread is threading.current_thread():
            return task()
        if self._late is not None and not self._late.is_set():
            raise _hangs()
        answer, ended = Answer[T](), threading.Event()

        def run() -> None:
            try:
                if answer.set_running_or_notify_cancel():
                    answer.set_result(task())
            except BaseException as error:  # of the caller, who gets it
                answer.set_exception(error)
            finally:
                ended.set()

        self._post(run)
        deadline_s = time.monotonic() + _TASK_TIMEOUT_S
        while not wait([answer], _LOOK_S).done:
            if not thread.is_alive() and not answer.done():
                raise InternalError("The ROS thread has ended.", hint="Start the server again.")
            if time.monotonic() > deadline_s:
                answer.cancel()
                self._late = ended
                raise _hangs()
        return answer.result()

    def create(self, noun: str, name: str, ros_type: type | None, make: Callable[[Node], T]) -> T:
        """Create an entity of the node on the executor's thread.

        Args:
            noun, name, ros_type: as in `roboneuron.ros.executor.created`.
            make: creates it on the node.

        Raises:
            ConfigurationError, StateError: as `created`.
            InternalError: as `on_executor`.
        """
        node = self.node
        return self.on_executor(lambda: created(node, noun, name, ros_type, lambda: make(node)))

    def _post(self, run: Callable[[], None]) -> None:
        """Have the executor's thread call `run`, which must not raise."""
        try:
            self._executor.create_task(run)
        except (AttributeError, InvalidHandle) as error:  # the executor was shut down meanwhile
            raise InternalError("The ROS link is not open.") from error

    def follow(
        self,
        message_type: type[M],
        topic: str,
        callback: Callable[[M], None],
        depth: int = 1,
        *,
        latched: bool = True,
    ) -> Callable[[], None]:
        """Like `subscribe`, with the reliability of the publishers, also of later ones, but best
        effort for large messages (see `large_qos`); if `latched`, also receive the last message,
        if all publishers keep it.
        """

        def make(mismatched: Callable[[], None]) -> Callable[[], None]:
            publishers = self.node.get_publishers_info_by_topic(topic)
            qos = requested_qos(publishers, depth, latched=latched)
            if is_large(message_type) and qos.durability != DurabilityPolicy.TRANSIENT_LOCAL:
                qos = large_qos(depth)
            return self.subscribe(message_type, topic, callback, qos, mismatched)

        followed = _Followed(make, self._post)
        self.on_executor(followed.begin)
        return lambda: self.on_executor(followed.finish)

    def subscribe(
        self,
        message_type: type[M],
        topic: str,
        callback: Callable[[M], None],
        qos: QoSProfile | None = None,
        mismatched: Callable[[], None] | None = None,
    ) -> Callable[[], None]:
        """Subscribe to an absolute `topic`; the returned function ends it.

        Args:
            message_type: an ordinary rosidl class.
            topic: absolute.
            callback: called on the executor's thread; its exceptions are logged.
            qos: profile of the subscription; the topic's usual one if None.
            mismatched: called on that thread when a publisher offers less than `qos`, so that
                nothing comes from it; logged by rclpy if None.

        Raises:
            RoboNeuronError: as `create`.
        """
        asked = qos or usual_qos(topic)
        events = None
        if mismatched is not None:
            events = SubscriptionEventCallbacks(incompatible_qos=lambda _: mismatched())

        def deliver(message: M) -> None:
            try:
                callback(message)
            # a failing callback must not end the thread that monitors all modules
            except Exception:
                log.exception("The callback of %s failed.", topic)

        node = self.node
        subscription = self.create(
            "subscription",
            topic,
            message_type,
            lambda node: node.create_subscription(
                message_type, topic, deliver, asked, event_callbacks=events
            ),
        )
        return lambda: self.on_executor(lambda: node.destroy_subscription(subscription))

    def advertise(
        self, message_type: type[M], topic: str, qos: QoSProfile | None = None
    ) -> Callable[[M], None]:
        """Return a function that publishes on an absolute `topic` while the link is open and does
        nothing afterwards. Without `qos`, the topic's usual profile is used.
        """
        offered = qos or usual_qos(topic)
        publisher = self.create(
            "publisher",
            topic,
            message_type,
            lambda node: node.create_publisher(message_type, topic, offered),
        )
        return lambda message: self.send_if_possible(publisher, message)

    @staticmethod
    def send_if_possible(publisher: Publisher, message: object) -> None:
        """Publish, unless the context is closed."""
        with suppress(*_UNSENT):
            publisher.publish(message)

    def call(
        self, service_type: type, name: str, request: object, on_answer: Callable[[], None]
    ) -> Call:
        """Send a request to a service, without waiting.

        Args:
            service_type: an ordinary rosidl class.
            name: absolute name.
            request: request of that type.
            on_answer: called on the executor's thread when the answer has arrived, or when the call
                is cancelled.
        """
        future = self._client(service_type, name).call_async(request)
        future.add_done_callback(lambda _: on_answer())
        return future

    def is_service_ready(self, service_type: type, name: str) -> bool:
        """True if this node has discovered a server of the service; a killed server counts until
        its lease ends, after up to 20 s.
        """
        return bool(self._client(service_type, name).service_is_ready())

    def _client(self, service_type: type, name: str) -> Client:
        key = service_type, name
        return self._clients.get(key) or self.create(
            "client", name, service_type, lambda node: self._known_client(node, key)
        )

    def _known_client(self, node: Node, key: tuple[type, str]) -> Client:
        if key not in self._clients:
            self._clients[key] = node.create_client(*key)
        return self._clients[key]

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            log.debug("The ROS context was shut down.")
        # on closing, the executor's own guard condition is destroyed while its last task ends
        except Exception:
            if self._thread is not None:
                log.exception("The ROS thread ends.")
        if self._thread is threading.current_thread():
            self._on_lost()


def _log_failure(error: BaseException, name: str) -> None:
    log.error("A callback of %s failed.", name or "the ROS node", exc_info=error)


def _hangs() -> InternalError:
    return InternalError(f"The ROS thread did not answer within {_TASK_TIMEOUT_S:g} s.")
