"""Print a named code block of README.md: ``python3 .ci/readme.py main|test|example``.

A block is named by the HTML comment on the line before its fence. CI runs the commands that readers copy, so the two
cannot differ. Needs nothing but Python.
"""

import re
import sys
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"
BLOCK = re.compile(r"^<!-- (?P<name>[\w-]+) -->\n```\w*\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks() -> dict[str, str]:
    """Named code blocks of the README, in order."""
    return {match["name"]: match["body"] for match in BLOCK.finditer(README.read_text(encoding="utf-8"))}


if __name__ == "__main__":
    found = blocks()
    if len(sys.argv) != 2 or sys.argv[1] not in found:
        sys.exit(f"usage: python3 .ci/readme.py {{{','.join(found)}}}")
    print(found[sys.argv[1]], end="")
