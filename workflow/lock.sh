#!/usr/bin/env bash
# Renew requirements.lock from pyproject.toml, for every Python that it allows. Versions stay unless pyproject.toml asks for
# others; workflow/lock.sh --upgrade takes the newest of all. Needs `make setup`.
set -euo pipefail
cd "$(dirname "$0")/.."
.venv/bin/uv pip compile --quiet --universal --python-version 3.11.0 --extra dev --no-annotate --no-header --no-strip-extras \
    --output-file requirements.lock "$@" pyproject.toml
{
    echo "# Every version that the book is made with, for each Python and system; workflow/lock.sh renews this file."
    echo "# The CUDA libraries are left out: a build of PyTorch for graphics cards brings its own."
    grep -vE '^(cuda|nvidia)-|^triton=' requirements.lock
} >requirements.lock.new
mv requirements.lock.new requirements.lock
