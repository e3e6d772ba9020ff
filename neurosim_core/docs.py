"""`neurosim docs`: the documents as a site, built and served by MkDocs."""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from neurosim_core.install import install_hint

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "site"


def add_parser(commands: Any) -> None:
    """Add the command to those of `neurosim`."""
    docs = commands.add_parser("docs", help="build the documents as a site, and open it in a browser")
    docs.add_argument("--build", action="store_true", help="build it anew, print where it is, and stop")
    docs.add_argument("--port", type=_port, default=8000, help="port of the page (default: 8000)")
    docs.add_argument("--no-browser", action="store_true", help="print the address only")
    docs.set_defaults(command=_docs, computes=False)


def _port(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 65535:  # of port 0 nobody would learn which it became
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 65535, got {text}")
    return int(text)


def _docs(arguments: argparse.Namespace) -> int:
    """Build the site or serve it; a warning is an error."""
    if not (ROOT / "mkdocs.yml").is_file():
        raise FileNotFoundError(f"no documents beside {ROOT / 'neurosim_core'}: they are in a checkout")
    if importlib.util.find_spec("mkdocstrings") is None or importlib.util.find_spec("material") is None:
        raise ImportError(f"the site needs a generator: {install_hint('docs')}")
    if arguments.build:
        task = ["build", "--quiet", "--site-dir", str(SITE)]
    else:
        address = f"127.0.0.1:{arguments.port}"
        print(f"building the site (half a minute); then it is at http://{address}/ (Ctrl-C ends)", flush=True)
        task = ["serve", "--quiet", "--dev-addr", address, *["--open"] * (not arguments.no_browser)]
    command = [sys.executable, "-m", "mkdocs", *task, "--strict"]
    status = subprocess.call(command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"})
    if arguments.build and status == 0:
        print(f"{SITE / 'index.html'}")
    return status
