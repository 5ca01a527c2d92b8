#!/usr/bin/env bash
# Make or renew the virtual environment: set_up.sh FOLDER STAMP. The stamp is written last, so that an interrupted set-up
# does not count as done. PYTHON may name the interpreter.
set -euo pipefail
venv=$1 stamp=$2
workflow=$(dirname "$0")
fitting='import ensurepip, sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))'
export PYTHONUTF8=1 PIP_DISABLE_PIP_VERSION_CHECK=1 # UTF-8: pip writes the folder's name into scripts

say() { echo "set-up: $*"; }
fail() {
    say "$@" >&2
    exit 1
}
fits() { "$1" -c "$fitting" 2>/dev/null; }

find_python() {
    local python
    if [ -n "${PYTHON:-}" ]; then
        fits "$PYTHON" || fail "PYTHON=$PYTHON is no Python 3.11, 3.12 or 3.13 with venv"
        echo "$PYTHON"
        return
    fi
    for python in python3.11 python3.12 python3.13 python3 python; do
        if fits "$python"; then
            echo "$python"
            return
        fi
    done
    fetch_python
}

# Let uv, installed by pip into an environment of its own, bring Python 3.13 into the folder of that environment.
fetch_python() {
    local own=$venv-python answer
    say "no Python 3.11 to 3.13 with venv found; asking uv for Python 3.13" >&2
    answer=$( (python3 -m venv --clear "$own" && "$own/bin/python" -m pip install -qq uv -c requirements.lock) 2>&1) ||
        fail "a Python with venv is needed to install uv ($(last_line "$answer")); install one of Python 3.11 to 3.13: $(packages)"
    export UV_PYTHON_INSTALL_DIR=$PWD/$own/python UV_HTTP_RETRIES=0
    answer=$("$own/bin/uv" python install --no-progress 3.13 2>&1) ||
        fail "uv cannot bring Python 3.13 ($(last_line "$answer")); install Python 3.11 to 3.13 or name it: make PYTHON=... book"
    "$own/bin/uv" python find --managed-python 3.13
}

# Choose the build of PyTorch that fits the graphics card, if any; pip alone takes the CUDA libraries along on Linux.
install_torch() {
    local torch answer
    torch=$(sed -n 's/^\(torch==[^ ;]*\).*/\1/p' requirements.lock)
    if [ "$(uname)" != Linux ] || [[ $(installed torch) == "${torch#*==}"* ]]; then return; fi
    answer=$(by_uv --torch-backend=auto "$torch" -c requirements.lock 2>&1) && return
    say "PyTorch comes by pip, with CUDA unless pip finds another build (uv: $(last_line "$answer"))"
    by_pip "$torch" -c requirements.lock
}

by_pip() { "$venv/bin/python" -m pip install -qq "$@"; }
by_uv() { UV_HTTP_TIMEOUT=20 UV_HTTP_RETRIES=0 "$venv/bin/uv" pip install --quiet --python "$venv/bin/python" "$@"; }
installed() { "$venv/bin/python" -c "import importlib.metadata as m; print(m.version('$1'))" 2>/dev/null || true; }
last_line() { tail -n 1 <<<"$1" | sed 's/^ *//; s/^cause: //'; }
packages() { echo "apt-get install $(paste -sd ' ' apt.txt), or dnf install $(paste -sd ' ' "$workflow/dnf.txt")"; }

# One set-up at a time in one folder. The lock belongs to the open file, so it ends with this script, however that ends.
lock() {
    local python
    python=$(command -v "${PYTHON:-python3}" || command -v python3.11 || command -v python3.12 || command -v python3.13) || return 0
    exec 9>"$venv.lock"
    "$python" -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX | fcntl.LOCK_NB)' 2>/dev/null && return
    say "another set-up is at work in $venv; waiting for it"
    "$python" -c 'import fcntl; fcntl.flock(9, fcntl.LOCK_EX)' 2>/dev/null ||
        say "this file system has no locks; start no second set-up in this folder"
    if [ -e "$stamp" ]; then exit; fi
}

lock
rm -f "$venv"/set-up-*
# An environment with this file was left unfinished, and may hold half a package.
unfinished=$venv/unfinished
if [ -e "$unfinished" ] || ! "$venv/bin/python" -c "import pip; $fitting" 2>/dev/null; then
    python=$(find_python)
    say "$("$python" --version) into $venv"
    "$python" -m venv --clear "$venv"
fi
say "installing requirements.lock into $venv (a few minutes the first time)"
touch "$unfinished"
by_pip uv -c requirements.lock
install_torch
# uv takes half the time of pip, which in its turn knows indexes that uv has not been told of.
by_uv --compile-bytecode -r requirements.lock 2>/dev/null || by_pip -r requirements.lock
by_pip --no-deps --no-build-isolation -e .
"$venv/bin/python" -m pip check
rm "$unfinished"
for module in numpy cv2 torch open3d; do
    answer=$("$venv/bin/python" -c "import $module" 2>&1) ||
        fail "$module cannot be imported: $(last_line "$answer"). The system's packages that are needed: $(packages)"
done
# Builds the font cache now; else the first chapter to draw would speak of it on stderr.
"$venv/bin/python" -c 'import matplotlib.pyplot' 2>/dev/null
touch "$stamp"
