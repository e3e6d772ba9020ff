"""What users are told to install: from a checkout, or the libraries themselves."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from neurosim_core.install import install_hint

DISTRIBUTION = "neurosim-core"
ROOT = Path(__file__).resolve().parents[1]
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
SUFFIXES = {".py", ".md", ".xml", ".txt", ".toml", ".yaml", ".yml", ".h", ".hpp", ".c", ".cpp", ""}


def test_no_text_installs_the_distribution_by_name():
    """Neither name is ours on the package index, where anybody can put a package of that name."""
    git = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(git, cwd=ROOT, capture_output=True, text=True, check=True)
    by_name = re.compile(r"pip install[^\n]*?[ '\"](neurosim|neurosim-core|neurosim_core|cortex)\b(?!/)")
    extra_by_name = re.compile(r"(?<![/\w])neurosim(-core)?\\*\[")
    for name in listed.stdout.split():
        path = ROOT / name
        if path.suffix not in SUFFIXES or not path.is_file() or path == Path(__file__):
            continue
        text = path.read_text(encoding="utf-8").replace(f'"{DISTRIBUTION}[', "")  # extras of extras
        assert not by_name.search(text), name
        assert not extra_by_name.search(text), name


def test_hints_name_extras_that_exist():
    used = {
        extra
        for path in (ROOT / "neurosim_core").rglob("*.py")
        for extra in re.findall(
            r"(?:install_hint\(|need\(\"[^\"]+ needs? [^\"]+\", )['\"](\w+)['\"]",
            path.read_text(encoding="utf-8"),
        )
    }
    assert {"view", "record", "video", "render"} <= used
    extras = PROJECT.partition("[project.optional-dependencies]")[2].partition("[project.scripts]")[0]
    assert used <= set(re.findall(r"^(\w+) = \[", extras, flags=re.MULTILINE))
    assert f'\nname = "{DISTRIBUTION}"' in PROJECT
    assert "pip install -e '.[view]'" in install_hint("view")


def test_a_foreign_cortex_is_refused_in_words(tmp_path):
    foreign = tmp_path / "cortex"
    foreign.mkdir()
    (foreign / "__init__.py").write_text("raise SystemExit('the foreign package ran')\n")
    code = f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(ROOT)!r}]; import neurosim_core.live.topics"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert f"ImportError: `import cortex` finds {foreign}" in done.stderr
    assert "pip uninstall cortex" in done.stderr


def test_a_bridge_without_its_libraries_says_what_to_install():
    """What a user has who installed the simulator alone."""
    code = (
        "import importlib.abc, sys\n"
        "class Absent(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'rosbags': raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "from cortex_ros2_bridge.__main__ import main\n"
        "sys.exit(main())\n"
    )
    done = subprocess.run([sys.executable, "-c", code, "--list"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == (
        "cortex-ros2-bridge: the bridge needs rosbags, which is not installed: "
        "pip install -e '.[ros2]' in the folder of Neurosim\n"
    )
