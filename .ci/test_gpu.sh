#!/usr/bin/env bash
# Tests that need a CUDA device. PYTHON names another interpreter than .venv's.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}

"$python" -c 'import sys, warp as wp; sys.exit(None if wp.is_cuda_available() else "no CUDA device: nothing to test")'
"$python" -m pytest -m cuda "$@"
