"""What tests ask a page in a browser."""

from __future__ import annotations

from collections.abc import Callable

from rn_testing import waiting

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


def wait_until(is_so: Callable[[], bool]) -> None:
    """Wait for a condition; patient, because pages render on the CPU, which other programs use
    too.
    """
    waiting.wait_until(is_so, 90.0, poll_s=0.05)
