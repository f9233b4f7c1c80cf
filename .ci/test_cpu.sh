#!/usr/bin/env bash
# The README's test command, word for word, in one process for each core: makes or reuses .venv, installs, tests.
set -euo pipefail
cd "$(dirname "$0")/.."

export PIP_QUIET=1 PYTEST_ADDOPTS="-n auto ${PYTEST_ADDOPTS:-}"
bash -euo pipefail -c "$(python3 .ci/readme.py test)"
