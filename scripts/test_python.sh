#!/usr/bin/env bash
# Runs part of the tests with a newer Python than .venv's, in an environment of its own under build/, with the newest
# packages that pyproject.toml admits.
#
#   scripts/test_python.sh [--brief] [PYTHON]     without PYTHON: the newest of $versions that this machine has
#
# --brief runs what has depended on Python's version so far, until the first failure: types, recordings, and the list of
# them. Where nothing can be installed for it, it says so and ends well, as without a newer Python.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export OPENBLAS_NUM_THREADS=1

versions=(3.13 3.12)
tests=(
  tests/cameras tests/datasets/test_scene_files.py tests/datasets/test_colmap_model.py tests/datasets/test_hloc_scene.py
  tests/datasets/test_kapture_scene.py tests/solvers/test_baseline_solvers.py tests/estimators/test_mc.py
  tests/estimators/test_ransac_baselines.py tests/test_recording.py tests/test_reopen.py tests/test_run_list.py
  tests/test_recording_background.py tests/test_repeat.py tests/test_cli.py tests/test_walls.py
)

brief=(
  tests/cameras/test_camera_round_trip.py tests/test_reopen.py tests/test_repeat.py tests/test_recording_round_trip.py
  tests/test_run_list.py tests/test_recording_untrusted.py
)
packages=('.[test]') words=() missing=1
if [ "${1:-}" = --brief ]; then
  shift
  tests=("${brief[@]}") words=(-x) missing=0
  packages=('.[catalog]' 'pytest>=8,<10' 'pytest-timeout>=2.3.1' 'pytest-xdist>=3.6.1' 'hypothesis>=6.100')
fi

# The path of a Python VERSION that runs: on PATH, or one of pyenv's.
find_python() {
  local path
  for path in "$(command -v "python$1")" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/"python$1"; do
    if [ -n "$path" ] && "$path" -c 'import ensurepip, venv' 2>/dev/null; then
      printf '%s\n' "$path"
      return
    fi
  done
}

python=${1:-}
own=$(.venv/bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || own=none
for version in "${versions[@]}"; do
  [ "$own" != "$version" ] || break
  [ -n "$python" ] || python=$(find_python "$version")
done
if [ -z "$python" ]; then
  echo "spherloc: no newer Python to test with was found (looked for ${versions[*]}; .venv has $own); skipped"
  exit
fi
venv=build/python-$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
echo "spherloc: part of the tests with $("$python" --version) in $venv"
"$python" -m venv "$venv"
"$venv/bin/python" -m pip install -q --disable-pip-version-check --upgrade --upgrade-strategy eager \
  -e "${packages[0]}" "${packages[@]:1}" || { echo "spherloc: its packages cannot be installed here; skipped"; exit $missing; }
exec "$venv/bin/python" -m pytest "${words[@]}" -n 2 --dist loadfile -m 'not browser' "${tests[@]}"
