"""The machine's V4L2 devices, and names for them that stay the same when they are plugged anew."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roboneuron import ConfigurationError, NotReadyError

SYSTEM = Path("/")
"""Root of the folders `sys` and `dev`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class VideoDevice:
    """A V4L2 node.

    Attributes:
        node: its path, /dev/video0.
        card: name that the driver gives it; several cameras of one make have the same.
        links: stable paths of the node: those by serial number (by-id), then by port (by-path).
        unit: the piece of hardware; a camera may have further nodes, without pictures of their own.
    """

    node: str
    card: str
    links: tuple[str, ...]
    unit: str

    @property
    def name(self) -> str:
        """Its most stable path."""
        return self.links[0] if self.links else self.node


def video_devices() -> tuple[VideoDevice, ...]:
    """The nodes in the order of their numbers; those of a camera that was just unplugged may be
    missing.

    Source: Linux, Documentation/ABI (class/video4linux), and udev's 60-persistent-v4l.rules.
    """
    links = dict(_links())
    folders = (SYSTEM / "sys/class/video4linux").glob("video[0-9]*")
    found = []
    for folder in sorted(folders, key=lambda path: int(path.name.removeprefix("video") or 0)):
        try:
            card = (folder / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            continue
        node = f"/dev/{folder.name}"
        own = tuple(link for link, target in links.items() if target == node)
        unit = str((folder / "device").resolve())
        found.append(VideoDevice(node=node, card=card, links=own, unit=unit))
    return tuple(found)


def _links() -> Iterator[tuple[str, str]]:
    """Stable paths with their nodes."""
    for folder in ("by-id", "by-path"):
        for link in sorted((SYSTEM / "dev/v4l" / folder).glob("*")):
            yield f"/dev/v4l/{folder}/{link.name}", f"/dev/{link.resolve().name}"


def node_of(device: int | str) -> int | str:
    """What OpenCV opens for the option `device`: a number and a path as they are, for a card name
    the first node of the camera with it.

    Raises:
        NotReadyError: no camera has that name.
        ConfigurationError: several have it.
    """
    if isinstance(device, int) or device.startswith("/"):
        return device
    present = video_devices()
    named = [one for one in present if one.card == device]
    units = {one.unit: one for one in reversed(named)}
    if len(units) > 1:
        raise ConfigurationError(
            f"{len(units)} cameras are called {device!r}.",
            hint=f"Name one by its path: {', '.join(sorted(one.name for one in units.values()))}.",
        )
    if not named:
        cards = ", ".join(dict.fromkeys(repr(one.card) for one in present)) or "none"
        raise NotReadyError(
            f"There is no camera called {device!r}; V4L2 devices present: {cards}.",
            hint="Plug it in, or correct the option device.",
        )
    return named[0].node
