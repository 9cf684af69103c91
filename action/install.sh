#!/usr/bin/env bash
# Installs what the input `package` names; by default the code of which this action is a part.
set -euo pipefail

root=$(cd "$GITHUB_ACTION_PATH/.." && pwd)
if [ -n "${INPUT_PACKAGE:-}" ]; then
  python -m pip install --disable-pip-version-check -- "$INPUT_PACKAGE"
else
  python -m pip install --disable-pip-version-check --constraint "$root/constraints.txt" -- "$root"
fi
