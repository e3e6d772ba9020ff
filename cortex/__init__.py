"""Cortex: typed publish/subscribe at memory speed, safe enough for control.

Everything public is here; importing the package loads nothing heavy until a name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cortex.codec import MalformedMessage as MalformedMessage
    from cortex.context import Closed as Closed
    from cortex.link import Info as Info
    from cortex.loan import Loan as Loan
    from cortex.message_types import Array as Array
    from cortex.message_types import Float32 as Float32
    from cortex.message_types import Float64 as Float64
    from cortex.message_types import Int8 as Int8
    from cortex.message_types import Int16 as Int16
    from cortex.message_types import Int32 as Int32
    from cortex.message_types import Int64 as Int64
    from cortex.message_types import UInt8 as UInt8
    from cortex.message_types import UInt16 as UInt16
    from cortex.message_types import UInt32 as UInt32
    from cortex.message_types import UInt64 as UInt64
    from cortex.message_types import Unit as Unit
    from cortex.message_types import message as message
    from cortex.node import Node as Node
    from cortex.overview import Liveliness as Liveliness
    from cortex.policy import Policy as Policy
    from cortex.policy import keep_last as keep_last
    from cortex.policy import latest as latest
    from cortex.policy import reliable as reliable
    from cortex.publisher import Publisher as Publisher
    from cortex.schema import TypeMismatch as TypeMismatch
    from cortex.service import ServiceFailed as ServiceFailed
    from cortex.service import ServiceTimeout as ServiceTimeout
    from cortex.service import ServiceUnavailable as ServiceUnavailable
    from cortex.subscriber import Subscriber as Subscriber
    from cortex.synchronise import synchronised as synchronised

_HOME = {
    name: module
    for module, names in {
        "codec": "MalformedMessage",
        "context": "Closed",
        "link": "Info",
        "loan": "Loan",
        "message_types": "Array Float32 Float64 Int8 Int16 Int32 Int64 UInt8 UInt16 UInt32 UInt64 Unit "
        "message",
        "node": "Node",
        "overview": "Liveliness",
        "policy": "Policy keep_last latest reliable",
        "publisher": "Publisher",
        "schema": "TypeMismatch",
        "service": "ServiceFailed ServiceTimeout ServiceUnavailable",
        "subscriber": "Subscriber",
        "synchronise": "synchronised",
    }.items()
    for name in names.split()
}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'cortex' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"cortex.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
