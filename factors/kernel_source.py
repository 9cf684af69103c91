"""The source files that the machine code of a kernel depends on."""

import ast
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.util import resolve_name
from pathlib import Path

_Name = tuple[str, str]  # a module, and a name in it; or all its names
_ALL = "*"
_DECORATOR = "compiled"


def source_files(module: str) -> list[Path]:
    """The file of a module with kernels, and those of what its kernels use, transitively.

    Followed are the names in the kernels, then those in what defines them, through imports, in the
    modules of the same package and of this one. A file too many is possible, such as that of a
    constant with the name of a kernel's variable. Where the decorator has another name than
    ``compiled``, or is an attribute of a module, all that the module uses is followed.

    Not followed are values that a constant gets from a file, from a function by ``global``, or from
    another module by ``module.CONSTANT = value``.
    """
    packages = {name.partition(".")[0] for name in (module, __name__)}
    found: set[_Name] = set()
    pending = set(_definitions(module)[_DECORATOR]) or {(module, _ALL)}
    while pending:
        found |= pending
        used = {use for name in pending for use in _uses(name)}
        pending = {use for use in used - found if use[0].partition(".")[0] in packages}
        pending = {use for use in pending if use[0] in sys.modules}  # else for type checkers alone
    modules = {module, *(owner for owner, _ in found)}
    return [Path(str(sys.modules[owner].__file__)) for owner in sorted(modules)]


def _uses(name: _Name) -> Iterable[_Name]:
    definitions = _definitions(name[0])
    if name[1] == _ALL:
        return {use for uses in definitions.values() for use in uses}
    return definitions.get(name[1], set()) | definitions.get(_ALL, set())  # of ``import *``


@cache
def _definitions(module: str) -> Mapping[str, set[_Name]]:
    """What the definition of each name of a module uses; the kernels' under ``_DECORATOR``."""
    text = Path(str(sys.modules[module].__file__)).read_bytes()
    found: dict[str, set[_Name]] = defaultdict(set)
    for statement in ast.parse(text).body:
        names = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
        imports = list(_imports(module, statement))
        loaded = {node.id for node in names if isinstance(node.ctx, ast.Load)}
        used = {(module, name) for name in loaded - {_DECORATOR}}
        used |= {origin for _, origin in imports}
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            found[statement.name] |= used
        elif not isinstance(statement, ast.ImportFrom | ast.Import):
            for node in names:  # what it assigns, or may change
                found[node.id] |= used
        for name, origin in imports:
            if name != _DECORATOR:
                found[name].add(origin)
        if _DECORATOR in loaded:
            found[_DECORATOR] |= used
    return found


def _imports(module: str, statement: ast.stmt) -> Iterator[tuple[str, _Name]]:
    """The names that a statement imports, and where they are from; a module is all its names."""
    for node in ast.walk(statement):
        if isinstance(node, ast.ImportFrom):
            package = str(sys.modules[module].__package__)
            source = resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                whole = f"{source}.{alias.name}" in sys.modules
                origin = (f"{source}.{alias.name}", _ALL) if whole else (source, alias.name)
                yield alias.asname or alias.name, origin
        elif isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.asname or alias.name.partition(".")[0], (alias.name, _ALL)
