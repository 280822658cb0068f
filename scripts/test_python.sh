#!/usr/bin/env bash
# Runs part of the tests with a newer Python than .venv's, in an environment of its own under build/, with the newest
# packages that pyproject.toml admits.
#
#   scripts/test_python.sh [PYTHON]     without PYTHON: the newest of $versions that this machine has
#
# Where there is none it says so and ends well.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

versions=(3.13 3.12)
tests=(
  tests/cameras tests/datasets/test_scene_files.py tests/datasets/test_colmap_model.py tests/datasets/test_hloc_scene.py
  tests/datasets/test_kapture_scene.py tests/solvers/test_baseline_solvers.py tests/estimators/test_mc.py
  tests/estimators/test_ransac_baselines.py tests/test_recording.py tests/test_reopen.py tests/test_run_list.py
  tests/test_recording_background.py tests/test_repeat.py tests/test_cli.py tests/test_walls.py
)

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
"$venv/bin/python" -m pip install -q --disable-pip-version-check --upgrade --upgrade-strategy eager -e '.[test]'
exec "$venv/bin/python" -m pytest -n 2 --dist loadfile -m 'not browser' "${tests[@]}"
