"""`neurosim docs`: build the site of the documents if they have changed, and show it."""

from __future__ import annotations

import argparse
import functools
import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from neurosim_core.install import install_hint
from neurosim_core.signals import handle_signals

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "site"
_SOURCES = ("mkdocs.yml", "docs/**/*", "examples/*.py", "*.md", "cortex/**/*.md", "neurosim_core/**/*.py")


def add_parser(commands: Any) -> None:
    """Add the command to those of `neurosim`."""
    docs = commands.add_parser("docs", help="build the documents as a site, and open it in a browser")
    docs.add_argument("--build", action="store_true", help="build it anew, print where it is, and stop")
    docs.add_argument("--port", type=int, default=0, help="port of the page (default: any)")
    docs.add_argument("--no-browser", action="store_true", help="print the address only")
    docs.set_defaults(command=_docs)


def build_site() -> Path:
    """Build the site, and say that it takes its time; a warning is an error. Return its folder.

    Raises:
        FileNotFoundError: The package lies outside of a checkout, which has the documents.
        ImportError: The generator is not installed.
        RuntimeError: The documents have errors.
    """
    if not (ROOT / "mkdocs.yml").is_file():
        raise FileNotFoundError(f"no documents beside {ROOT / 'neurosim_core'}: they are in a checkout")
    if importlib.util.find_spec("mkdocstrings") is None or importlib.util.find_spec("material") is None:
        raise ImportError(f"the site needs a generator: {install_hint('docs')}")
    print("building the site (half a minute)", flush=True)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(SITE)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode != 0:
        raise RuntimeError(f"the documents have errors:\n{done.stdout}{done.stderr}")
    return SITE


def is_current() -> bool:
    """Return whether the site is younger than all that it is made of."""
    index = SITE / "index.html"
    if not index.is_file():
        return False
    newest = max(file.stat().st_mtime for pattern in _SOURCES for file in ROOT.glob(pattern))
    return index.stat().st_mtime >= newest


def _docs(arguments: argparse.Namespace) -> int:
    if arguments.build or not is_current():
        build_site()
    if arguments.build:
        print(f"{SITE / 'index.html'}")
        return 0
    import http.server
    import webbrowser

    class _Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Say nothing of each file."""

    handler = functools.partial(_Quiet, directory=str(SITE))
    with http.server.ThreadingHTTPServer(("127.0.0.1", arguments.port), handler) as server:
        address = f"http://127.0.0.1:{server.server_port}/index.html"
        print(f"open {address}   (Ctrl-C ends)", flush=True)
        if not arguments.no_browser:
            webbrowser.open(address)
        with handle_signals(signal.default_int_handler):
            server.serve_forever()
    return 0
