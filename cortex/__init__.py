"""Cortex: typed publish/subscribe at memory speed, safe enough for control.

Everything public is here; importing the package loads nothing heavy until a name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

# Not on demand: once the module `cortex.message` is loaded, it would stand where the decorator belongs.
from cortex.message import message

if TYPE_CHECKING:
    from cortex.codec import MalformedMessage
    from cortex.context import Closed
    from cortex.link import Info
    from cortex.liveliness import Liveliness
    from cortex.loan import Loan
    from cortex.message import (
        Array,
        Float32,
        Float64,
        Int8,
        Int16,
        Int32,
        Int64,
        UInt8,
        UInt16,
        UInt32,
        UInt64,
        Unit,
    )
    from cortex.node import Node
    from cortex.policy import Policy, keep_last, latest, reliable
    from cortex.publisher import Publisher
    from cortex.schema import TypeMismatch
    from cortex.service import ServiceFailed, ServiceTimeout, ServiceUnavailable
    from cortex.subscriber import Subscriber
    from cortex.synchronise import synchronised

_HOME = {
    "Array": "message",
    "Closed": "context",
    "Float32": "message",
    "Float64": "message",
    "Info": "link",
    "Int8": "message",
    "Int16": "message",
    "Int32": "message",
    "Int64": "message",
    "Liveliness": "liveliness",
    "MalformedMessage": "codec",
    "Node": "node",
    "Policy": "policy",
    "Loan": "loan",
    "Publisher": "publisher",
    "ServiceFailed": "service",
    "ServiceTimeout": "service",
    "ServiceUnavailable": "service",
    "Subscriber": "subscriber",
    "TypeMismatch": "schema",
    "UInt8": "message",
    "UInt16": "message",
    "UInt32": "message",
    "UInt64": "message",
    "Unit": "message",
    "keep_last": "policy",
    "latest": "policy",
    "reliable": "policy",
    "synchronised": "synchronise",
}

__all__ = [
    "Array",
    "Closed",
    "Float32",
    "Float64",
    "Info",
    "Int8",
    "Int16",
    "Int32",
    "Int64",
    "Liveliness",
    "Loan",
    "MalformedMessage",
    "Node",
    "Policy",
    "Publisher",
    "ServiceFailed",
    "ServiceTimeout",
    "ServiceUnavailable",
    "Subscriber",
    "TypeMismatch",
    "UInt8",
    "UInt16",
    "UInt32",
    "UInt64",
    "Unit",
    "keep_last",
    "latest",
    "message",
    "reliable",
    "synchronised",
]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'cortex' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"cortex.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
