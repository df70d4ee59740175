"""The server's ROS node: one context, one node, one executor thread; usable from any thread."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias, TypeVar, cast

import rclpy
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.task import Future

from roboneuron.errors import InternalError
from roboneuron.ros.qos import requested_qos, usual_qos

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
_LEAVE_S = 2.0
"""Timeout for the end of the executor and of its thread: a hanging callback must not block the
server's exit.
"""


class RosLink:
    """A node of the server.

    Entities are created and destroyed on the executor's thread, which also runs callbacks;
    callbacks must return quickly. rclpy builds its wait set from the node's entities: destroying
    one on another thread would leave a dead handle in it.
    """

    def __init__(self, node_name: str) -> None:
        """Args:
        node_name: name in the root namespace.
        """
        self._node_name = node_name
        self._context: Any = None
        self._node: Any = None
        self._executor: Any = None
        self._thread: threading.Thread | None = None
        self._clients: dict[tuple[type, str], Client] = {}
        # Guards the clients, also while one is created on the executor's thread: callbacks, which
        # run there, must not request a client.
        self._lock = threading.Lock()

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
        self._executor = SingleThreadedExecutor(context=self._context)
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
        """Run `task` on the executor's thread; return its result or raise its exception.

        Not callable from that thread (deadlock).

        Raises:
            InternalError: the link is not open, or its thread hangs.
        """
        if self._thread is None:
            raise InternalError("The ROS link is not open.")
        done = threading.Event()
        future = self._executor.create_task(task)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(_TASK_TIMEOUT_S):
            raise InternalError(f"The ROS thread did not answer within {_TASK_TIMEOUT_S:g} s.")
        return cast("T", future.result())

    def follow(
        self,
        message_type: type[M],
        topic: str,
        callback: Callable[[M], None],
        depth: int = 1,
        *,
        latched: bool = True,
    ) -> Callable[[], None]:
        """Like `subscribe`, with the reliability of the present publishers; if `latched`, also
        receive the last message, if all publishers keep it.
        """
        return self.subscribe(
            message_type,
            topic,
            callback,
            requested_qos(self.node.get_publishers_info_by_topic(topic), depth, latched=latched),
        )

    def subscribe(
        self,
        message_type: type[M],
        topic: str,
        callback: Callable[[M], None],
        qos: QoSProfile | None = None,
    ) -> Callable[[], None]:
        """Subscribe to an absolute `topic`; the returned function ends it.

        Args:
            message_type: an ordinary rosidl class.
            topic: absolute.
            callback: called on the executor's thread; its exceptions are logged.
            qos: profile of the subscription; the topic's usual one if None.
        """
        asked = qos or usual_qos(topic)

        def deliver(message: M) -> None:
            try:
                callback(message)
            # a failing callback must not end the thread that monitors all modules
            except Exception:
                log.exception("The callback of %s failed.", topic)

        node = self._node
        subscription = self.on_executor(
            lambda: node.create_subscription(message_type, topic, deliver, asked)
        )
        return lambda: self.on_executor(lambda: node.destroy_subscription(subscription))

    def advertise(
        self, message_type: type[M], topic: str, qos: QoSProfile | None = None
    ) -> Callable[[M], None]:
        """Return a function that publishes on an absolute `topic` while the link is open and does
        nothing afterwards. Without `qos`, the topic's usual profile is used.
        """
        offered = qos or usual_qos(topic)
        publisher = self.on_executor(
            lambda: self._node.create_publisher(message_type, topic, offered)
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
        with self._lock:
            client = self._clients.get((service_type, name))
            if client is None:
                client = self.on_executor(lambda: self._node.create_client(service_type, name))
                self._clients[service_type, name] = client
            return client

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            log.debug("The ROS context was shut down.")
        except InvalidHandle:
            # on closing, the executor's own guard condition is destroyed while its last task ends
            if self._thread is not None:
                raise
