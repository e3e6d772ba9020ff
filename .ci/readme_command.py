"""Print a command of the README: the bash block under the comment `<!-- command: NAME -->`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

README = Path(__file__).resolve().parents[1] / "README.md"


def readme_commands() -> dict[str, str]:
    """Return every named command of the README."""
    pattern = r"<!-- command: (\w+) -->\s*```bash\n(.*?)```"
    return {
        name: body.strip() for name, body in re.findall(pattern, README.read_text("utf-8"), flags=re.DOTALL)
    }


if __name__ == "__main__":
    print(readme_commands()[sys.argv[1]])
