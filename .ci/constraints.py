"""Write ``constraints.txt``: the versions that this environment's tests run with. ``python .ci/constraints.py``.

Run it where the tests have passed, with nothing installed from elsewhere than the package index.
"""

import platform

from supply import ROOT, installed

HEAD = """\
# Versions that softwarp's tests have passed with, made by .ci/constraints.py on Python {python}, {system}:
#     pip install -c constraints.txt .
# Without it pip takes the newest versions that pyproject.toml allows; .ci/newest tests those.
"""


def text() -> str:
    """The file: a line for each package, direct or not."""
    head = HEAD.format(python=platform.python_version(), system=f"{platform.system()} {platform.machine()}")
    return head + "".join(f"{package.name}=={package.version}\n" for package in installed().values())


if __name__ == "__main__":
    (ROOT / "constraints.txt").write_text(text(), encoding="utf-8")
    print(f"constraints.txt: {len(installed())} packages")
