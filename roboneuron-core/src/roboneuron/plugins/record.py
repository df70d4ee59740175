"""What discovery found: one record for each plugin, one offer for each descriptor, each with a status and a reason."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from roboneuron.plugins.specs import Spec


class Status(StrEnum):
    """Whether something can be used. The order is the order of severity: a plugin has the worst of its offers."""

    READY = "ready"
    DISABLED = "disabled"
    UNAVAILABLE = "unavailable"
    INCOMPATIBLE = "incompatible"
    CONFLICT = "conflict"
    FAILED = "failed"


SEVERITY: tuple[Status, ...] = tuple(Status)
"""Statuses from best to worst."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Offer:
    """One descriptor that an installed plugin offers.

    Attributes:
        spec: the descriptor.
        distribution: name of the package it comes from.
        status: READY when it can be used.
        reason: why not, and what to do about it; empty when ready.
    """

    spec: Spec
    distribution: str
    status: Status
    reason: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PluginRecord:
    """One entry point of the group `roboneuron`.

    Attributes:
        distribution: name of the package.
        version: its version; empty when its metadata have none.
        module: the plugin module that the entry point names.
        status: the worst of its offers, or FAILED or DISABLED for the whole.
        reason: why it is not ready; empty when it is.
        traceback: of the exception that made it fail; empty otherwise.
        offers: what it offers, in the order of its hooks, also what cannot be used.
    """

    distribution: str
    version: str
    module: str
    status: Status
    reason: str = ""
    traceback: str = ""
    offers: tuple[Offer, ...] = ()
