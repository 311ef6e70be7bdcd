#!/bin/sh
# Make $VENV with the pinned dependencies and optsim on top; name the one command that cures what is missing.
set -eu
VENV=${VENV:-.venv}

supported='import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))'

if ! command -v git >/dev/null 2>&1; then
  echo "optsim: git is missing. Cure (Debian, Ubuntu): apt-get install git" >&2
  exit 2
fi

if [ -z "${PYTHON:-}" ]; then
  for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null 2>&1 && "$candidate" -c "$supported" 2>/dev/null; then
      PYTHON=$candidate
      break
    fi
  done
fi
if [ -z "${PYTHON:-}" ] && ! command -v uv >/dev/null 2>&1; then
  echo "optsim: no Python 3.11 to 3.14 found. Cure (Debian, Ubuntu): apt-get install python3 python3-venv" >&2
  echo "        or name one: make PYTHON=/path/to/python3.12 setup" >&2
  exit 2
fi
if [ -n "${PYTHON:-}" ] && ! "$PYTHON" -c "$supported" 2>/dev/null; then
  echo "optsim: PYTHON=$PYTHON is not a Python 3.11 to 3.14. Cure: make PYTHON=python3.12 setup" >&2
  exit 2
fi

if command -v uv >/dev/null 2>&1; then
  uv venv --quiet --clear ${PYTHON:+--python "$PYTHON"} "$VENV"
  uv pip install --quiet --python "$VENV/bin/python" --require-hashes -r requirements.txt
  uv pip install --quiet --python "$VENV/bin/python" --no-build-isolation --no-deps -e .
else
  if ! "$PYTHON" -c 'import venv, ensurepip' 2>/dev/null; then
    echo "optsim: $PYTHON has no venv module. Cure (Debian, Ubuntu): apt-get install python3-venv" >&2
    exit 2
  fi
  "$PYTHON" -m venv --clear "$VENV"
  "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
  "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
fi
echo "optsim: $VENV is ready"
