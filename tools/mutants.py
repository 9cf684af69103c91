"""Do the tests find faults? Mutants of lines that two versions share, tried in each of them.

    python tools/mutants.py draw BEFORE AFTER mutants.json --count 150
    python tools/mutants.py try BEFORE mutants.json before.jsonl
    python tools/mutants.py try AFTER mutants.json after.jsonl --found-in before.jsonl
    python tools/mutants.py compare mutants.json before.jsonl after.jsonl

A mutant changes one operator or number of a line that stands, in a function of the same name and
folder, in both trees; kernels are left out. Its tests are those of its folder and of
``tests/test_pipeline.py`` that run this line, which coverage has recorded once for each tree. All
is imported and collected once; each mutant is a fork in which the functions' code is exchanged, so
programs that a test starts do not have it. A stopped run continues: a line of results is written
per mutant.
"""

from __future__ import annotations

import argparse
import ast
import gc
import importlib
import json
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import _lru_cache_wrapper, partial
from hashlib import sha256
from itertools import groupby
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import coverage
import pytest

FOLDERS = ("factors", "calibgraph/graph", "calibgraph/solver", "calibgraph/io", "calibgraph/audit")
_SECONDS = 300.0  # of the tests of a mutant; one that hangs is found
_RECORD_SECONDS = 3600.0  # of a file of tests, with coverage
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
        if isinstance(function, ast.FunctionDef) and not _is_kernel(function):
            for node in _own_nodes(function.body):
                for line, column, old, new in _mutations(node, lines):
                    yield function.name, line, column, old, new


def _own_nodes(nodes: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """Nodes below these, without those of functions and classes that are defined there."""
    for node in nodes:
        if not isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node
            yield from _own_nodes(ast.iter_child_nodes(node))


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


def draw(before: Path, after: Path, count: int) -> list[Place]:
    """Mutants of both trees; their order does not depend on ``after``."""
    shared = places(before).keys() & places(after).keys()
    return sorted(shared, key=lambda place: sha256(f"0 {place}".encode()).digest())[:count]


def mutate(tree: Path, place: Place, where: tuple[Path, int]) -> None:
    """Exchange the code of the functions that have the line, in this process."""
    path, line = tree / where[0], where[1]
    source = path.read_text("utf-8").splitlines(keepends=True)
    original, column = source[line - 1], place[3]
    at = len(original) - len(original.lstrip()) + column
    source[line - 1] = original[:at] + place[5] + original[at + len(place[4]) :]
    codes = {_name(code): code for code in _codes(compile("".join(source), str(path), "exec"))}
    gc.unfreeze()
    there = [one for one in gc.get_objects() if type(one) is FunctionType]
    changed = False
    for function in there:
        old = function.__code__
        new = codes.get(_name(old)) if old.co_filename == str(path) else None
        if new is not None and new.co_freevars == old.co_freevars and new != old:
            function.__code__, changed = new, True
    if not changed:
        raise RuntimeError(f"{where}: no function in memory has this line")


def _name(code: CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _codes(code: CodeType) -> Iterator[CodeType]:
    """A code, and all that it defines."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


class Trial:
    """A plugin of pytest: in place of running the tests it tries mutants.

    Args:
        tree: that is imported.
        mutants: in the order of the trial.
        results: a line of JSON per mutant; the tests' lines are kept beside it.
    """

    def __init__(self, tree: Path, mutants: list[Place], results: Path) -> None:
        self.tree, self.mutants, self.results = tree, mutants, results
        self.failed, self.ran = False, dict[str, dict[str, Any]]()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember failures, and seconds."""
        self.failed |= report.failed
        record = self.ran.setdefault(report.nodeid, {"seconds": 0.0, "passed": True})
        record["seconds"] += report.duration
        record["passed"] &= not report.failed

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Record which test runs which line, then try the mutants."""
        for folder in FOLDERS:
            for path in sorted((self.tree / folder).rglob("*.py")):
                name = path.relative_to(self.tree).with_suffix("")
                importlib.import_module(".".join(name.parts).removesuffix(".__init__"))
        tests = self.record(session.items, self.results.with_suffix(".lines.json"))
        items = {item.nodeid: item for item in session.items}
        wheres, done = places(self.tree), read_results(self.results)
        for place in self.mutants:
            if place in wheres and place not in done:
                path, line = wheres[place]
                mine = tests_of(tests, place[0], str(path), line)
                attempt = partial(self.attempt, place, wheres[place], [items[n] for n in mine])
                found = in_fork(attempt, _SECONDS)
                found = "a crash, or too long" if found is None else found
                record = {"place": place, "file": str(path), "line": line, "tests": len(mine)}
                with self.results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({**record, "found_by": found}) + "\n")
        return True

    def record(self, items: list[pytest.Item], path: Path) -> dict[str, Any]:
        """Per test its seconds, whether it passes, and the lines it runs, by file; kept."""
        found = dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}
        for _, group in groupby(items, lambda item: item.path):
            own = [item for item in group if item.nodeid not in found]
            if own:
                found |= in_fork(partial(self._record_file, own), _RECORD_SECONDS) or {}
                path.write_text(json.dumps(found), "utf-8")
        return found

    def _record_file(self, items: list[pytest.Item]) -> dict[str, Any]:
        sources = [f"{self.tree / folder}/*" for folder in FOLDERS]
        tracer = coverage.Coverage(None, config_file=False, include=sources)
        tracer.set_option("run:disable_warnings", ["no-data-collected"])
        tracer.start()
        for item, after in zip(items, [*items[1:], None], strict=False):
            tracer.switch_context(item.nodeid)
            for each in gc.get_objects():  # what tests share is made by each that uses it
                if type(each) is _lru_cache_wrapper and each.__module__.startswith("tests"):
                    each.cache_clear()
            item.ihook.pytest_runtest_protocol(item=item, nextitem=after)
        tracer.stop()
        data = tracer.get_data()
        for name, record in self.ran.items():
            data.set_query_context(name)
            record["lines"] = {
                str(Path(file).relative_to(self.tree)): lines
                for file in data.measured_files() if (lines := data.lines(file))
            }  # fmt: skip
        return self.ran

    def attempt(self, place: Place, where: tuple[Path, int], items: list[pytest.Item]) -> str:
        """The test that finds a mutant in this fork, or nothing."""
        mutate(self.tree, place, where)
        for item, after in zip(items, [*items[1:], None], strict=False):
            item.ihook.pytest_runtest_protocol(item=item, nextitem=after)
            if self.failed:
                return str(item.nodeid)
        return ""


def tests_of(tests: dict[str, Any], folder: str, file: str, line: int) -> list[str]:
    """Tests of the folder and of the pipeline that run a line, the fastest file first."""
    own = f"tests/{folder.removeprefix('calibgraph/')}/"
    mine = {
        name: test["seconds"] for name, test in tests.items()
        if name.startswith((own, "tests/test_pipeline.py"))
        and test["passed"] and line in test["lines"].get(file, ())
    }  # fmt: skip
    files = Counter[str]()
    for name, seconds in mine.items():
        files[name.split("::")[0]] += seconds
    return sorted(mine, key=lambda n: (files[n.split("::")[0]], n.split("::")[0], mine[n]))


def in_fork(work: Callable[[], Any], most_s: float) -> Any:
    """What a function returns in a fork of this process; None if that crashes or takes too long.

    Raises:
        RuntimeError: if the function fails.
    """
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=lambda: sender.send(work()))
    child.start()
    sender.close()
    try:
        return receiver.recv() if receiver.poll(most_s) else None
    except EOFError:
        child.join()
        if child.exitcode == 1:
            raise RuntimeError("a fork failed, as it says above") from None
        return None
    finally:
        child.kill()
        child.join()


def try_all(tree: Path, mutants: list[Place], results: Path) -> int:
    """Try the mutants that have no line of results yet."""
    os.chdir(tree)
    sys.path.insert(0, str(tree))
    tests = [f"tests/{folder.removeprefix('calibgraph/')}" for folder in FOLDERS]
    words = ["-n", "0", "-q", "-p", "no:cacheprovider", *tests, "tests/test_pipeline.py"]
    return int(pytest.main(words, plugins=[Trial(tree, mutants, results)]))


def read_results(path: Path) -> dict[Place, str]:
    """Per mutant what found it; nothing for one that survives."""
    lines = path.read_text("utf-8").splitlines() if path.exists() else []
    records = [json.loads(line) for line in lines]
    return {tuple(record["place"]): record["found_by"] for record in records}


def compare(before: Path, after: Path) -> int:
    """Print the counts, and each mutant that was found before and survives after."""
    old, new = read_results(before), read_results(after)
    found = [place for place in old if old[place]]
    tried = [place for place in found if place in new]
    lost = [place for place in tried if not new[place]]
    print(f"{len(old)} mutants tried before, {len(found)} found; of these {len(tried)} tried "
          f"after, {len(tried) - len(lost)} found")  # fmt: skip
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
    parser.add_argument("--found-in", type=Path, help="only mutants that these results found")
    asked = parser.parse_args()
    first, second, third = (path.resolve() for path in asked.paths)
    if asked.command == "draw":
        third.write_text(json.dumps(draw(first, second, asked.count), indent=0))
    elif asked.command == "try":
        mutants = [tuple(place) for place in json.loads(second.read_text())]
        if asked.found_in:
            found = read_results(asked.found_in)
            mutants = [place for place in mutants if found.get(place)]
        sys.exit(try_all(first, mutants, third))
    else:
        sys.exit(bool(compare(second, third)))


if __name__ == "__main__":
    main()
