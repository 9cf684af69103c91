#!/usr/bin/env bash
# Runs `calibgraph check` with the inputs of the action, and writes its outputs and summary.
# Exit code: 0 OK, 1 WRONG, 2 it could not be checked, 3 CANNOT TELL if that is to fail.
set -uo pipefail

options=(--tolerance-deg "$INPUT_TOLERANCE_DEG" --tolerance-cm "$INPUT_TOLERANCE_CM" --json)
if [ -n "${INPUT_FRAMES:-}" ]; then
  options+=(--frames "$INPUT_FRAMES")
fi
if [ -n "${INPUT_PAGE:-}" ]; then
  options+=(--page "$INPUT_PAGE")
fi
datasets=()
while IFS= read -r line; do
  if [ -n "$line" ]; then
    datasets+=("$line")
  fi
done <<< "$INPUT_DATASET"

found="$RUNNER_TEMP/calibgraph-check.json"
messages="$RUNNER_TEMP/calibgraph-check.txt"
python -m calibgraph check "${options[@]}" -- "$INPUT_RIG" "${datasets[@]}" > "$found" 2> "$messages"
code=$?
cat "$messages" >&2
python "$GITHUB_ACTION_PATH/summarize.py" "$code" "$found" "$messages" || exit 2
if [ "$code" = 3 ] && [ "${INPUT_FAIL_ON_CANNOT_TELL:-false}" != true ]; then
  exit 0
fi
exit "$code"
