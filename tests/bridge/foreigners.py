"""Processes that speak DDS as foreign nodes do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from processes import ROOT, Child, Lines

_PEER = Path(__file__).with_name("dds_peer.py")


class Foreigner(Child):
    """A process of `dds_peer.py`: what it can do is there."""

    hello: Any = "it says none"

    def __init__(self, domain: int, **environment: str) -> None:
        process = subprocess.Popen(
            [sys.executable, str(_PEER), str(domain)],
            env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
        )
        Lines.__init__(self, process, "dds_peer")

    def do(self, what: str, **arguments: Any) -> Any:
        """Let it do something, and return what came of it."""
        return self.ask(do=what, **arguments)["answer"]
