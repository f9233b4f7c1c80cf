#!/usr/bin/env bash
# Generated pages are up to date; links, code blocks, commands, tutorials and the README's example work. PYTHON names another interpreter.
# .ci/run has all of it but the cells of tutorials and the code of long pages.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}

"$python" docs/generate.py --check
"$python" -m pytest -q -m "" tests/contract/test_docs.py tests/contract/test_tutorials.py \
    tests/contract/test_commands.py
