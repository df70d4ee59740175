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

UNLABELLED = """() => {
  const named = one => one.getAttribute('aria-label') || one.innerText.trim() || one.title ||
    [...(one.labels || [])].map(label => label.innerText).join('') ||
    (one.getAttribute('aria-labelledby') || '').split(' ').map(id => document.getElementById(id)?.innerText).join('');
  return [...document.querySelectorAll('button, input, select, textarea, a[href], [role=button], [role=slider]')]
    .filter(one => one.getClientRects().length && !named(one)).map(one => one.outerHTML);
}"""  # noqa: E501
"""Controls that a screen reader cannot name."""
TEXT_CONTRAST = """id => {
  const light = text => {
    const parts = text.match(/[\\d.]+/g).slice(0, 3).map(v => v / 255);
    const [r, g, b] = parts.map(v => v <= .03928 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4);
    return .2126 * r + .7152 * g + .0722 * b;
  };
  const behind = one => {
    for (let at = one; at; at = at.parentElement) {
      const colour = getComputedStyle(at).backgroundColor;
      if (!/^rgba\\(.*, 0\\)$/.test(colour)) return colour;
    }
    return "rgb(255, 255, 255)";
  };
  const says = one => !one.disabled && one.checkVisibility() &&
    [...one.childNodes].some(part => part.nodeType === 3 && part.data.trim());
  return Math.min(...[...document.querySelectorAll(`#${id} *`)].filter(says).map(one => {
    const [a, b] = [light(getComputedStyle(one).color), light(behind(one))];
    return (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
  }));
}"""
"""Least contrast of a text within an element. Source: WCAG 2.2, relative luminance."""
LEAST_CONTRAST = 4.5


def wait_until(is_so: Callable[[], bool]) -> None:
    """Wait for a condition; patient, because pages render on the CPU, which other programs use
    too.
    """
    waiting.wait_until(is_so, 90.0, poll_s=0.05)
