#!/usr/bin/env bash
# Style, types, kernel rules and import layers. PYTHON names another interpreter than .venv's.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}

"$python" -m ruff check
"$python" -m ruff format --check
"$python" -m mypy
"$python" .ci/check_kernels.py
"$python" -m pytest -q tests/contract/test_layers.py
