"""A node in a process of its own that serves and runs one service and one action.

python serving_node.py PACKAGE SERVICE ACTION
"""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib import import_module

import rclpy
from rclpy.action import ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node

from rn_interfaces.finder import install


def serve(package: str, service: str, action: str) -> None:
    """Serve until a signal comes."""
    install()
    rclpy.init()
    node = Node("server")
    served = getattr(import_module(f"{package}.srv"), service)
    node.create_service(served, "/served", lambda request, response: response)
    run = getattr(import_module(f"{package}.action"), action)
    running = ActionServer(node, run, "/run", lambda goal: run.Result())
    print("there", flush=True)
    with suppress(ExternalShutdownException, KeyboardInterrupt):
        rclpy.spin(node)
    del running


if __name__ == "__main__":
    serve(*sys.argv[1:])
