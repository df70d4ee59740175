"""Folders of a Linux machine with V4L2 devices."""

from __future__ import annotations

from pathlib import Path

SERIAL = "/dev/v4l/by-id/usb-046d_C270_4A1B-video-index0"
PORT = "/dev/v4l/by-path/pci-0000:00:14.0-usb-0:2:1.0-video-index0"


def make_machine(root: Path) -> None:
    """A webcam with a second node for metadata, two cameras of one make, one without links."""
    nodes = {
        "video0": ("HD Webcam C270", "usb1"),
        "video1": ("HD Webcam C270", "usb1"),
        "video2": ("Twin", "usb2"),
        "video3": ("Twin", "usb3"),
        "video10": ("Grabber", "pci"),
    }
    for node, (card, unit) in nodes.items():
        (root / "sys/devices" / unit).mkdir(parents=True, exist_ok=True)
        folder = root / "sys/class/video4linux" / node
        folder.mkdir(parents=True)
        (folder / "name").write_text(f"{card}\n")
        (folder / "device").symlink_to(root / "sys/devices" / unit)
        (root / "dev").mkdir(exist_ok=True)
        (root / "dev" / node).touch()
    links = {SERIAL: "video0", PORT: "video0", "/dev/v4l/by-path/twin-2": "video3"}
    for link, node in links.items():
        path = root / link.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(f"../../{node}")
