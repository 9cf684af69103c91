"""The commands of the tutorial with their output: run, and compared with the page or written to it.

    python -m docs.transcripts

writes the output of the program into the page.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```text\n\$ calibgraph (?P<command>.*)\n(?P<output>(?:.*\n)*?)```", re.M)


def run(command: str, folder: Path) -> str:
    """What a command prints for people, in a folder that has ``data``; trailing blanks removed."""
    done = subprocess.run(
        [sys.executable, "-m", "calibgraph", *command.split()],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100", "PYTHONWARNINGS": "ignore"},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = (line.rstrip() for line in done.stderr.splitlines())
    return "\n".join(line for line in lines if line and not _PROGRESS.match(line))


_PROGRESS = re.compile(r" +\d+ s  ")  # printed by a slow machine more often than by a fast one


def main() -> None:
    """Write the output of every command into the page; ``out`` is made in the current folder."""
    text = PAGE.read_text("utf-8")
    new = BLOCK.sub(_with_output, text)
    PAGE.write_text(new, "utf-8")


def shown(output: str, before: str) -> str:
    """The output as a block shows it: its first lines, if the block ends with ``...``."""
    lines = before.splitlines()
    if lines[-1:] == ["..."]:
        return "\n".join([*output.splitlines()[: len(lines) - 1], "..."])
    return output


def _with_output(block: re.Match[str]) -> str:
    command = block["command"]
    return f"```text\n$ calibgraph {command}\n{shown(run(command, Path()), block['output'])}\n```"


if __name__ == "__main__":
    main()
