"""Commands as typer takes them: the help of an option is a line of the docstring around it.

A command is a function with plain types. Its section ``Args`` has a line per option, ``name
(VALUE): help``, with the value's name as the help shows it; a class of options has these lines
under ``Attributes``; options that several commands share have theirs in
:mod:`calibgraph.cli.options`. What has a default is an option, what has none an argument.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import MISSING, fields, is_dataclass
from functools import wraps
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ParameterInfo

from calibgraph.cli import options

_SECTION = re.compile(r"\n\n(?:Args|Attributes):\n")
_ENTRY = re.compile(r"(\w+)(?: \((.+?)\))?: (.*)")


def declare(command: Callable[..., None]) -> Callable[..., None]:
    """A command for typer; parameters of a class of options become the options of that class."""
    hints = get_type_hints(command, include_extras=True)
    groups = {name: hint for name, hint in hints.items() if is_dataclass(hint)}

    @wraps(command)
    def run(**values: Any) -> None:
        for name, group in groups.items():
            own = {field.name: values.pop(field.name) for field in fields(group)}
            values[name] = group(**own)  # type: ignore[operator]
        command(**values)

    parameters = [each for name in inspect.signature(command).parameters
                  for each in _parameters(command, name, hints, groups)]  # fmt: skip
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run


def help_of(command: Callable[..., None]) -> str:
    """Its docstring without the options, a line per paragraph."""
    text = _SECTION.split(inspect.getdoc(command) or "")[0]
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in text.split("\n\n"))


def _parameters(
    command: Callable[..., None], name: str, hints: dict[str, Any], groups: dict[str, Any]
) -> Iterator[inspect.Parameter]:
    """The options of a parameter: itself, or those of its class."""
    if name not in groups:
        default = inspect.signature(command).parameters[name].default
        yield _parameter(name, default, hints[name], _entries(options) | _entries(command))
        return
    of_group = get_type_hints(groups[name], include_extras=True)
    entries = _entries(options)
    for base in reversed(groups[name].__mro__):
        entries |= _entries(base)
    for field in fields(groups[name]):
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        yield _parameter(field.name, default, of_group[field.name], entries)


def _entries(documented: Any) -> dict[str, tuple[str | None, str]]:
    """Per option of a docstring, the name of its value and its help."""
    _, *sections = _SECTION.split(inspect.cleandoc(documented.__doc__ or ""))
    lines = re.sub(r"\n\s{5,}", " ", "".join(sections)).splitlines()
    found = [_ENTRY.fullmatch(line.strip()) for line in lines]
    return {each[1]: (each[2], each[3]) for each in found if each is not None}


def _parameter(
    name: str, default: Any, hint: Any, entries: dict[str, tuple[str | None, str]]
) -> inspect.Parameter:
    """A parameter with its typer option or argument, and the help that belongs to it."""
    kind, *extras = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    given = next((each for each in extras if isinstance(each, ParameterInfo)), None)
    if given is None:
        given = typer.Argument() if default is inspect.Parameter.empty else typer.Option()
    given = copy(given)
    if not default and kind in (bool, bool | None) and given.default is ...:
        given.param_decls = (f"--{name.replace('_', '-')}",)  # and no --no-NAME
    metavar, text = entries.get(name, (None, None))
    given.metavar, given.help = given.metavar or metavar, given.help or text
    keyword = inspect.Parameter.KEYWORD_ONLY
    others = [each for each in extras if not isinstance(each, ParameterInfo)]
    hint = Annotated[kind, given, *others]
    return inspect.Parameter(name, keyword, default=default, annotation=hint)
