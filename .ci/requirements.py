"""Print what softwarp and its tests ask for, a requirement a line: ``python .ci/requirements.py [--beyond]``.

With ``--beyond`` without upper bounds, which .ci/newest tries. Needs the package ``packaging``.
"""

import sys

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from supply import EXTRAS, declared


def unbounded(requirement: Requirement) -> Requirement:
    """A requirement with its lower bounds only."""
    kept = SpecifierSet(",".join(str(part) for part in requirement.specifier if part.operator in (">=", ">", "!=")))
    loose = Requirement(str(requirement))
    loose.specifier = kept
    return loose


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["--beyond"]):
        sys.exit("usage: python .ci/requirements.py [--beyond]")
    for wanted in declared(EXTRAS):
        print(unbounded(wanted) if sys.argv[1:] else wanted)
