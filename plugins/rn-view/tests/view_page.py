"""What tests ask a page in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable

PIXEL = """() => {
  const found = [...document.querySelectorAll('img')].find(i => /^(blob:|data:image.jpeg)/.test(i.src));
  if (!found || !found.complete || !found.naturalWidth) return -1;
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = 1;
  const pen = canvas.getContext('2d');
  pen.drawImage(found, 0, 0, 1, 1);
  return pen.getImageData(0, 0, 1, 1).data[0];
}"""  # noqa: E501
"""Red of the first picture's first pixel; -1 while there is none."""


def wait_until(is_so: Callable[[], bool], *, timeout_s: float = 90.0) -> None:
    """Wait for a condition; a page draws with the processor here, which others use too."""
    deadline_s = time.monotonic() + timeout_s
    while not is_so():
        assert time.monotonic() < deadline_s, "it did not come"
        time.sleep(0.05)
