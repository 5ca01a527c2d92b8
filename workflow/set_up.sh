#!/usr/bin/env bash
# Make or renew the virtual environment: set_up.sh FOLDER STAMP. The stamp is written last, so that an interrupted set-up
# does not count as done. PYTHON may name the interpreter.
set -euo pipefail
venv=$1 stamp=$2
fitting='import ensurepip, sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))'

find_python() {
    for python in ${PYTHON:-} python3.11 python3.12 python3 python; do
        if "$python" -c "$fitting" 2>/dev/null; then
            echo "$python"
            return
        fi
    done
    echo "set-up: no Python 3.11 or 3.12 (with venv) found; install one or name it: make PYTHON=... book" >&2
    return 1
}

if ! "$venv/bin/python" -c "import pip; $fitting" 2>/dev/null; then
    python=$(find_python)
    echo "set-up: $("$python" --version) into $venv"
    "$python" -m venv --clear "$venv"
fi
echo "set-up: installing requirements.lock into $venv (a few minutes the first time)"
rm -f "$venv"/set-up-*
pip() { "$venv/bin/python" -m pip --disable-pip-version-check "$@"; }
pip install -qq -r requirements.lock
pip install -qq --no-deps --no-build-isolation -e .
pip check
# Builds the font cache now; else the first chapter to draw would speak of it on stderr.
"$venv/bin/python" -c 'import matplotlib.pyplot' 2>/dev/null
touch "$stamp"
