#!/usr/bin/env bash
# Installs what a make target needs into .venv and, if the system lacks it, from Debian; a repeated call is quick.
#
#   scripts/setup.sh play|test|lint|bench|docs     "test" prints the path of the browser for the tests on stdout
#
# It works, or it ends with one sentence that says what to do.  Python is $PYTHON, else python3.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

target=${1:-}
case $target in
  play) extras='' enough=(play test lint bench docs) ;; # any of these targets' packages will do
  test) extras='[test]' enough=(test lint) ;;
  lint) extras='[test,lint]' enough=(lint) ;;
  bench) extras='[bench]' enough=(bench) ;;
  docs) extras='[docs]' enough=(docs) ;;
  *) echo "usage: scripts/setup.sh play|test|lint|bench|docs" >&2 && exit 2 ;;
esac
python=${PYTHON:-python3}
venv=.venv/bin/python

say() { printf 'spherloc: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }
trap 'echo >&2; die "stopped; the same command goes on from here."' INT

# watch COMMAND...: runs it with its last line and the seconds as one changing line (on a terminal) or as a line every ten
# seconds (elsewhere); shows the end of its output when it fails.
watch() {
  local log status=0
  log=$(mktemp)
  "$@" 2>&1 | tee "$log" | show_progress || status=$?
  [ $status -eq 0 ] || tail -n 40 "$log" >&2
  rm -f "$log"
  return $status
}

show_progress() {
  local line last='' got begin=$SECONDS next=$((SECONDS + 10))
  while :; do
    got=0
    IFS= read -r -t 1 line || got=$?
    line=${line%$'\r'}
    [ -z "$line" ] || last=${line##*$'\r'}
    [ $got -eq 0 ] || [ $got -gt 128 ] || break # more than 128: a second without a line
    if [ -t 2 ]; then
      printf '\r\033[K%5d s  %s' $((SECONDS - begin)) "${last:0:70}" >&2
    elif [ $SECONDS -ge $next ]; then
      printf '%5d s  %s\n' $((SECONDS - begin)) "${last:0:100}" >&2
      next=$((SECONDS + 10))
    fi
  done
  [ ! -t 2 ] || printf '\r\033[K' >&2
}

# --- what the system has to bring -------------------------------------------------------------------------------------

venv_works() { "$venv" -c '' 2>/dev/null; }

runs() { timeout 60 "$1" --version >/dev/null 2>&1; }

find_chromium() {
  local name path
  for name in chromium chromium-browser google-chrome google-chrome-stable microsoft-edge; do
    path=$(command -v "$name") && runs "$path" && printf '%s\n' "$path" && return
  done
  return 1
}

# The Debian packages that are missing, one in a line.
missing_packages() {
  if ! venv_works; then
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
  fi
  if [[ $target = @(test|lint) ]] && [ "$(uname -s)" = Linux ]; then
    # Playwright's own node is linked against it.
    "$python" -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2>/dev/null || echo libatomic1
  fi
  if [ "$target" = test ] && [ -z "$chromium" ]; then echo chromium; fi
}

# install_debian PACKAGE...: as root or through sudo; dies with the sentence to follow when neither works.
install_debian() {
  local as_root=() sentence
  command -v apt-get >/dev/null ||
    die "'make $target' needs what Debian calls $*, and this system has no apt-get: install it another way and try again."
  sentence="'make $target' needs packages that only an administrator can install; ask for: apt-get install $*"
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || die "$sentence"
    if ! sudo -n true 2>/dev/null; then
      [ -t 0 ] && [ -t 2 ] || die "$sentence"
      say "'make $target' needs Debian's $*; sudo may ask for your password"
      sudo -v || die "$sentence"
    fi
    as_root=(sudo)
  fi
  say "installing from Debian: $*"
  local apt=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o DPkg::Lock::Timeout=300)
  watch "${apt[@]}" update || say "apt-get update had trouble (above); going on with the package lists at hand"
  watch "${apt[@]}" install -y --no-install-recommends "$@" ||
    die "apt-get could not install $*, for the reason above; mend that and try again."
}

# --- steps ------------------------------------------------------------------------------------------------------------

check_python() {
  local version='import sys; print("%d.%d" % sys.version_info[:2])'
  if venv_works; then
    [ "$("$python" -c "$version" 2>/dev/null)" = "$("$venv" -c "$version")" ] ||
      say "using the $("$venv" --version) of .venv, not $python; 'make clean' first, to start from that."
    python=$venv
    return
  fi
  command -v "$python" >/dev/null || die "there is no $python; name a Python 3.11 or newer with: make PYTHON=/path/to/python3"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    die "$python is $("$python" --version 2>&1), too old; name a Python 3.11 or newer with: make PYTHON=/path/to/python3"
}

check_chromium() {
  if [ -z "${SPHERLOC_CHROMIUM:-}" ]; then
    chromium=$(find_chromium) || chromium=''
  else
    chromium=$(command -v "$SPHERLOC_CHROMIUM") && runs "$chromium" ||
      die "SPHERLOC_CHROMIUM is '$SPHERLOC_CHROMIUM', which does not run; set it to the path of a Chromium, or unset it."
  fi
}

install_packages() {
  local packages
  mapfile -t packages < <(missing_packages)
  [ ${#packages[@]} -gt 0 ] || return 0
  install_debian "${packages[@]}"
  mapfile -t packages < <([ "$target" != test ] || check_chromium && missing_packages)
  [ ${#packages[@]} -eq 0 ] || die "${packages[*]} was installed and still does not work: is $python Debian's own?"
}

install_python() {
  # An environment is up to date if it still runs and was filled in this place from this pyproject.toml.
  local stamp=.venv/.installed-for- state other
  state=$(pwd -P && cksum <pyproject.toml)
  if venv_works; then
    for other in "${enough[@]}"; do
      [ "$(cat "$stamp$other" 2>/dev/null)" != "$state" ] || return 0
    done
  else
    say "making a virtual environment in .venv with $("$python" --version 2>&1)"
    "$python" -m venv --clear .venv >&2 || die "$python could not make .venv, for the reason above; mend that and try again."
  fi
  "$venv" -m pip --version >/dev/null 2>&1 || "$venv" -m ensurepip >/dev/null 2>&1 ||
    die ".venv has no pip; run 'make clean' and try again."
  say "installing Python packages into .venv (the first time takes a minute or more)"
  # Most modules are never imported; the others are compiled when they are.
  watch "$venv" -m pip install --disable-pip-version-check --no-compile -e ".$extras" ||
    die "pip could not install the packages, for the reason above; mend that and try again."
  if [[ $target != @(lint|docs) ]]; then
    "$venv" -c 'import sys; from spherloc.warm_up import warm_up
warm_up(lambda words: print(f"spherloc: {words}", file=sys.stderr), sys.argv[1:] or None)' \
      $([ "$target" != play ] || echo mc) ||
      die "the solvers could not be prepared, for the reason above; mend that and try again."
  fi
  printf '%s\n' "$state" >"$stamp$target"
}

chromium=''
check_python
[ "$target" != test ] || check_chromium
install_packages
[ "$target" != test ] || check_chromium
install_python
[ -z "$chromium" ] || printf '%s\n' "$chromium"
