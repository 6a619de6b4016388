#!/bin/sh
# Creates the virtual environment $1 with everything in constraints.txt, or brings it up to date.
# PYTHON=... chooses the interpreter, PIP_OPTIONS=... adds options to `pip install`.
set -eu
cd "$(dirname "$0")/.."
venv=$1

# The versions every pinned wheel exists for.
suitable() {
    "$1" -c 'import sys, venv, ensurepip
sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' >/dev/null 2>&1
}

find_python() {
    for candidate in ${PYTHON:-python3.12 python3.11 python3.13 python3.14 python3}; do
        if suitable "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    echo "make env: no Python 3.11 ... 3.14 with venv among '${PYTHON:-python3*}';" \
        "on Debian 12 or Ubuntu 24.04: apt install python3-venv" >&2
    return 1
}

if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    # `venv --clear` would delete a folder with other files.
    if [ -d "$venv" ] && [ -n "$(ls -A "$venv")" ] && [ ! -e "$venv/pyvenv.cfg" ]; then
        echo "make env: $venv is there and no virtual environment: name another with VENV=..." >&2
        exit 2
    fi
    python=$(find_python)
    echo "make env: creating $venv with $("$python" --version)"
    "$python" -m venv --clear "$venv"
fi

# Names each package on a terminal, where a person watches; a log gets only what went wrong.
quiet=--quiet
if [ -t 1 ]; then quiet=; fi

echo "make env: installing the packages pinned in constraints.txt (minutes the first time)"
pip_install() {
    # shellcheck disable=SC2086
    "$venv/bin/python" -m pip install --disable-pip-version-check $quiet ${PIP_OPTIONS:-} \
        --constraint constraints.txt "$@"
}
pip_install pip setuptools
# The pinned setuptools builds the package, not whichever is newest on the day. Its advice about
# editable installations is for other layouts.
PYTHONWARNINGS=ignore:::setuptools.command.editable_wheel \
    pip_install --no-build-isolation --editable '.[ros,train,data,onnx,sb3,film,cluster,docs,dev]'
