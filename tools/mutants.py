"""Do the tests find faults? Mutants of lines that two versions share, tried in each of them.

    python -m tools.mutants draw BEFORE AFTER mutants.json --count 150
    python -m tools.mutants try BEFORE mutants.json before.jsonl
    python -m tools.mutants try AFTER mutants.json after.jsonl
    python -m tools.mutants compare mutants.json before.jsonl after.jsonl

A mutant changes one operator or number of a line that stands, in a function of the same name and
folder, in both trees; kernels are left out. Tests of the folder run first, then
``tests/test_pipeline.py``. A stopped run continues: a line of results is written per mutant.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

FOLDERS = ("factors", "calibgraph/graph", "calibgraph/solver", "calibgraph/io", "calibgraph/audit")
_SECONDS = 900.0  # of the tests of a mutant; a mutant that hangs is found
_OPERATORS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Add: ("+", "-"), ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"), ast.Div: ("/", "*"), ast.And: ("and", "or"), ast.Or: ("or", "and"),
    ast.Is: ("is", "is not"), ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"), ast.MatMult: ("@", "*"),
}  # fmt: skip

Place = tuple[str, str, str, int, str, str]
"""Folder, function, line without its indent, column in it, what is replaced, and by what."""


def places(tree: Path) -> dict[Place, tuple[Path, int]]:
    """All mutants of a tree, with the file and the line; those that are ambiguous left out."""
    found: dict[Place, list[tuple[Path, int]]] = {}
    for folder in FOLDERS:
        for path in sorted((tree / folder).rglob("*.py")):
            lines = path.read_text("utf-8").splitlines()
            for function, line, column, old, new in _in_file(path, lines):
                text = lines[line - 1]
                indent = len(text) - len(text.lstrip())
                place = (folder, function, text.strip(), column - indent, old, new)
                found.setdefault(place, []).append((path.relative_to(tree), line))
    return {place: where[0] for place, where in found.items() if len(where) == 1}


def _in_file(path: Path, lines: list[str]) -> Iterator[tuple[str, int, int, str, str]]:
    """Function, line, column, what is there, and what replaces it."""
    for function in ast.walk(ast.parse(path.read_text("utf-8"))):
        if not isinstance(function, ast.FunctionDef) or _is_kernel(function):
            continue
        for statement in function.body:
            for node in ast.walk(statement):
                if isinstance(node, ast.FunctionDef):
                    continue
                for line, column, old, new in _mutations(node, lines):
                    yield function.name, line, column, old, new


def _is_kernel(function: ast.FunctionDef) -> bool:
    return any("compiled" in ast.unparse(each) for each in function.decorator_list)


def _mutations(node: ast.AST, lines: list[str]) -> Iterator[tuple[int, int, str, str]]:
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        if node.lineno == node.end_lineno:
            old = lines[node.lineno - 1][node.col_offset : node.end_col_offset]
            yield node.lineno, node.col_offset, old, f"({old} + 1)"
        return
    operands: list[tuple[ast.expr, ast.AST, ast.expr]] = []
    if isinstance(node, ast.Compare):
        lefts = [node.left, *node.comparators]
        operands = list(zip(lefts, node.ops, node.comparators, strict=False))
    elif isinstance(node, ast.BinOp):
        operands = [(node.left, node.op, node.right)]
    elif isinstance(node, ast.BoolOp):
        operands = [(a, node.op, b) for a, b in zip(node.values, node.values[1:], strict=False)]
    for left, operator, right in operands:
        pair, line = _OPERATORS.get(type(operator)), left.end_lineno
        if pair is None or line is None or line != right.lineno or left.end_col_offset is None:
            continue
        column = lines[line - 1].find(pair[0], left.end_col_offset, right.col_offset)
        if column >= 0:
            yield line, column, *pair


def draw(before: Path, after: Path, count: int, seed: int) -> list[Place]:
    """Mutants of both trees; their order does not depend on ``after``."""
    shared = places(before).keys() & places(after).keys()
    return sorted(shared, key=lambda place: sha256(f"{seed} {place}".encode()).digest())[:count]


def attempt(tree: Path, place: Place, work: Path) -> dict[str, Any]:
    """Run the tests of a mutant in a copy of the tree."""
    folder, _, text, column, old, new = place
    path, line = places(tree)[place]
    source = (tree / path).read_text("utf-8").splitlines(keepends=True)
    original = source[line - 1]
    at = len(original) - len(original.lstrip()) + column
    source[line - 1] = original[:at] + new + original[at + len(old) :]
    (work / path).write_text("".join(source), "utf-8")
    try:
        tests = [f"tests/{folder.removeprefix('calibgraph/')}", "tests/test_pipeline.py"]
        found = next((test for test in tests if not _passes(work, test)), "")
    finally:
        shutil.copy2(tree / path, work / path)
    return {"place": place, "file": str(path), "line": line, "text": text, "found_by": found}


def _passes(work: Path, test: str) -> bool:
    command = [sys.executable, "-m", "pytest", "-n", "0", "-x", "-q", test]
    environment = {**os.environ, "PYTHONPATH": str(work)}
    try:
        done = subprocess.run(
            command, cwd=work, env=environment, capture_output=True, timeout=_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def try_all(tree: Path, mutants: list[Place], results: Path) -> None:
    """Try the mutants that have no line of results yet."""
    lines = results.read_text("utf-8").splitlines() if results.exists() else []
    done = {tuple(json.loads(line)["place"]) for line in lines}
    with tempfile.TemporaryDirectory() as name:
        work = Path(name) / "tree"
        shutil.copytree(tree, work, ignore=shutil.ignore_patterns(".git", ".venv", "out", "build"))
        for number, place in enumerate(mutants):
            if place in done:
                continue
            record = attempt(tree, place, work)
            with results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
            print(number, record["found_by"] or "SURVIVES", place[1:], flush=True)


def compare(before: Path, after: Path) -> int:
    """Print the counts, and each mutant that was found before and survives after."""
    found = [
        {
            tuple(record["place"]): record["found_by"]
            for record in map(json.loads, path.read_text("utf-8").splitlines())
        }
        for path in (before, after)
    ]
    both = found[0].keys() & found[1].keys()
    lost = [place for place in sorted(both) if found[0][place] and not found[1][place]]
    counts = [sum(bool(each[place]) for place in both) for each in found]
    print(f"{len(both)} mutants in both: {counts[0]} found before, {counts[1]} after")
    for place in lost:
        print("lost:", place)
    return len(lost)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("command", choices=["draw", "try", "compare"])
    parser.add_argument("paths", type=Path, nargs=3)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    first, second, third = asked.paths
    if asked.command == "draw":
        third.write_text(json.dumps(draw(first, second, asked.count, asked.seed), indent=0))
    elif asked.command == "try":
        try_all(first.resolve(), [tuple(p) for p in json.loads(second.read_text())], third)
    else:
        sys.exit(bool(compare(second, third)))


if __name__ == "__main__":
    main()
