#!/usr/bin/env bash
# Run the unit tests of the core and the translator with the lowest versions that pyproject.toml allows, in build/lowest.
# Needs `make setup` with Python 3.11 and 6 GB of disk; arguments are pytest's.
set -euo pipefail
cd "$(dirname "$0")/.."
env=build/lowest
# These need what neither extra brings: the workflow, the simulator's Open3D, or packages for tests alone.
others='test_(copy_alone|examples|end_to_end|route_tables|profiles|progress|project|set_up|stage_book|shipped_networks|simulated_.*|sampled_points|rendered_points|two_sample_classifier)\.py$'

.venv/bin/python -m venv --clear $env
.venv/bin/uv pip install --quiet --python $env/bin/python --torch-backend=auto --resolution lowest-direct -e ".[translator]" 2>/dev/null ||
    .venv/bin/uv pip install --quiet --python $env/bin/python --resolution lowest-direct -e ".[translator]"
.venv/bin/uv pip install --quiet --python $env/bin/python pytest
$env/bin/python -m pip freeze | grep -iE '^(numpy|scipy|opencv|numba|pandas|pyyaml|torch|safetensors)'
readarray -t tests < <(ls tests/test_*.py | grep -vE "$others")
MPLBACKEND=Agg OMP_NUM_THREADS=1 $env/bin/python -m pytest -q "${tests[@]}" "$@"
