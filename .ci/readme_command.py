"""Print a command of the README: the bash block under the comment `<!-- command: NAME -->`.

Of a document, named by its path: all its bash and Python blocks as one script, for a folder of its own.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def readme_commands() -> dict[str, str]:
    """Return every named command of the README."""
    pattern = r"<!-- command: (\w+) -->\s*```bash\n(.*?)```"
    text = (ROOT / "README.md").read_text("utf-8")
    return {name: body.strip() for name, body in re.findall(pattern, text, flags=re.DOTALL)}


def script_of(page: Path) -> str:
    """Return the blocks of a document as a script; one that begins with `# FILE` is that file."""
    lines = ["set -euo pipefail"]
    pattern = r"^```(bash|python|yaml)\n(.*?)^```"
    for language, body in re.findall(pattern, page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE):
        name = re.match(r"# (\S+\.(?:py|yaml))\n", body)
        if language == "bash":
            lines.append(body)
        elif name is not None or language == "python":
            target = f"cat > {name[1]}" if name is not None else "python -"
            lines.append(f"{target} <<'BLOCK'\n{body}BLOCK")
    return "\n".join(lines)


if __name__ == "__main__":
    asked = sys.argv[1]
    print(script_of(ROOT / asked) if asked.endswith(".md") else readme_commands()[asked])
