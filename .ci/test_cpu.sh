#!/usr/bin/env bash
# The README's test command, word for word: makes or reuses .venv, installs, tests.
set -euo pipefail
cd "$(dirname "$0")/.."

export PIP_QUIET=1
bash -euo pipefail -c "$(python3 .ci/readme.py test)"
