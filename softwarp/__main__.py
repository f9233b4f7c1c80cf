"""``python -m softwarp`` is the ``softwarp`` command."""

import sys

from softwarp.cli import main

if __name__ == "__main__":
    sys.exit(main())
