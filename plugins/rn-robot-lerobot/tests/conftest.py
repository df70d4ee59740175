"""Make the modules next to the tests importable."""

from __future__ import annotations
