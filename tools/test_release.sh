#!/bin/sh
# Builds the documentation; builds sdist and wheel, checks them, installs
# the wheel where no source is, and uses it, also under the tests of Gymnasium-Robotics.
# PYTHON=... chooses the interpreter, PIP_OPTIONS=... adds options to `pip install`.
set -eu
cd "$(dirname "$0")/.."
root=$PWD
python=${PYTHON:-$root/.venv/bin/python}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
unset PYTHONPATH

began=$(date +%s)
say() { echo "test-release: $(($(date +%s) - began)) s: $*"; }

pip_install() {
    environment=$1
    shift
    # shellcheck disable=SC2086
    "$work/$environment/bin/python" -m pip install --disable-pip-version-check --quiet \
        ${PIP_OPTIONS:-} --constraint "$root/constraints.txt" "$@"
}

mkdir "$work/source"
git ls-files -z | xargs -0 tar -cf - | tar -xf - -C "$work/source"

say 'documentation of what git tracks: no warning, no request, nothing from elsewhere in its pages'
nowhere=http://127.0.0.1:9
(cd "$work/source" && http_proxy=$nowhere https_proxy=$nowhere \
    "$python" -m sphinx -W --keep-going -q -b html docs "$work/pages")
if grep -rlE '<(script|link|img|iframe)[^>]*(src|href)="(https?:)?//' --include='*.html' "$work/pages"; then
    say 'these pages load something from another host'
    exit 1
fi
rm -rf "$work/source/docs/generated"

say 'sdist and wheel'
"$python" -m venv "$work/tools"
pip_install tools build check-wheel-contents twine
(cd "$work/source" && "$work/tools/bin/python" -m build --outdir "$work/dist" >"$work/build.log" 2>&1) ||
    { cat "$work/build.log"; exit 1; }
"$work/tools/bin/python" -m twine check --strict "$work"/dist/*
"$work/tools/bin/check-wheel-contents" --config "$root/pyproject.toml" "$work"/dist/*.whl
wheel=$(echo "$work"/dist/*.whl)

say 'base installation: small, and enough for the environments'
"$python" -m venv "$work/base"
empty=$(du -sm "$work/base" | cut -f1)
pip_install base "$wheel"
size=$(($(du -sm "$work/base" | cut -f1) - empty))
say "the base installation adds $size MB (at most 350)"
[ "$size" -le 350 ]
mkdir "$work/elsewhere"
cd "$work/elsewhere"
"$work/base/bin/fetch_hand_sim" --version
"$work/base/bin/python" "$root/tools/try_environment.py"
for command in sim policy replay train benchmark; do
    if "$work/base/bin/fetch_hand_sim" $command >"$work/out" 2>&1; then exit 1; fi
    grep -q "pip install 'fetch_hand_sim\[" "$work/out" && [ "$(wc -l <"$work/out")" -eq 1 ] ||
        { cat "$work/out"; exit 1; }
done

say 'with ROS and actors: the demo'
pip_install base "$wheel[ros,actors]"
"$work/base/bin/fetch_hand_sim" demo --episodes 2
"$work/base/bin/fetch_hand_sim" episodes check episodes
"$work/base/bin/fetch_hand_sim" evaluate --policy FetchReach --episodes 20
say "a film by Gymnasium's RecordVideo, in an environment of its own: moviepy wants an older pillow"
"$python" -m venv "$work/film"
# Pinned as the rest, but for pillow.
grep -v '^pillow==' "$root/constraints.txt" >"$work/film.txt"
# shellcheck disable=SC2086
"$work/film/bin/python" -m pip install --disable-pip-version-check --quiet ${PIP_OPTIONS:-} \
    --constraint "$work/film.txt" "$wheel" moviepy
"$work/film/bin/python" "$root/tools/try_film.py"

say 'tests and examples of Gymnasium-Robotics, from its repository'
pip_install base pytest
suite=0
"$work/base/bin/python" "$root/tools/gymnasium_robotics_suite.py" || suite=$?
[ $suite -eq 0 ] || [ $suite -eq 3 ]
say 'done'
