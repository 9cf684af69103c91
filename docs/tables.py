"""The generated parts of the pages, from the code itself.

    python -m docs.tables

writes them anew between the lines ``<!-- generated: NAME -->`` and ``<!-- end generated -->``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import click
from pydantic import BaseModel
from typer.main import get_command

MADE_WRONG = Path(__file__).parents[1] / "benchmarks" / "made_wrong.json"
"""Counts of ``accuracy.verdicts``, ``street_verdicts`` and ``mixtures``, with their commits."""


def thresholds() -> str:
    """The thresholds of all checks."""
    from docs.thresholds_table import thresholds_markdown

    return thresholds_markdown()


def settings() -> str:
    """The settings of the solve: name, values, default, meaning."""
    from calibgraph.model.config import Config

    return settings_table(Config, leave_out={"preset", "tracking"})


def tracking_settings() -> str:
    """The settings under ``tracking``."""
    from calibgraph.model.config import Tracking

    return settings_table(Tracking)


def presets() -> str:
    """The settings in which the presets differ."""
    from calibgraph.model.config import PRESETS, preset

    values = {name: preset(name).model_dump(exclude={"preset"}) for name in PRESETS}
    rows = [
        [f"`{key}`", *(_default(of_preset[key]) for of_preset in values.values())]
        for key in next(iter(values.values()))
        if len({str(of_preset[key]) for of_preset in values.values()}) > 1
    ]
    return table(["setting", *(f"`{name}`" for name in PRESETS)], rows)


def commands() -> str:
    """Every command with its arguments and own options; what several share, once."""
    from calibgraph.cli.app import app
    from calibgraph.cli.options import SHARED
    from calibgraph.cli.settings import RareSettings

    found = [*_walk(get_command(app))]
    shared: dict[str, list[str]] = {}
    for parameter in (each for _, command in found for each in command.params):
        if parameter.name in SHARED and parameter.param_type_name == "option":
            shared.setdefault(parameter.name, _row(parameter))
    return "\n\n".join(
        [
            "### Options that several commands share",
            table(_HEADER, shared.values()),
            "### Keys of `--config` that have no option",
            "Beside those of the [settings](settings.md):",
            settings_table(RareSettings),
            *(_command(name, command, [*shared.values()]) for name, command in found),
        ]
    )


def api(*names: str) -> str:
    """Public functions with the first lines of their docstrings, then the types by name."""
    import calibgraph

    found = {name: getattr(calibgraph, name) for name in names}
    types = [f"`{name}`" for name, each in found.items() if isinstance(each, type)]
    functions = {n: each.__doc__ or "" for n, each in found.items() if f"`{n}`" not in types}
    lines = [f"* `{n}`: {_one_line(text.partition(_BLANK)[0])}" for n, text in functions.items()]
    return "\n".join([*lines, *([f"* Types: {', '.join(types)}"] if types else [])])


def made_wrong(part: str) -> str:
    """The ``headline`` or the ``table`` of how results that were made wrong are judged."""
    found = json.loads(MADE_WRONG.read_text("utf-8"))
    if part == "table":
        return table(found["columns"], found["rows"])
    wrong, passed = (sum(int(row[at]) for row in found["rows"]) for at in (1, 2))
    exceptions = [f"{error} off ({cause})" for error, cause in found["passed"]]
    if len(exceptions) != passed:
        raise ValueError(f"{passed} wrong results got PASS, and {len(exceptions)} are described")
    return f"Of {wrong} results made wrong on purpose, {passed} got PASS: {', '.join(exceptions)}."


GENERATED: Mapping[str, Callable[..., str]] = {
    "thresholds": thresholds,
    "settings": settings,
    "tracking settings": tracking_settings,
    "presets": presets,
    "commands": commands,
    "made wrong": made_wrong,
    "api": api,
}
"""By the first word or words after ``generated:``; what follows a colon are arguments."""

_HEADER = ["option", "meaning", "default"]
PART = re.compile(
    r"<!-- generated: (?P<name>[\w ]+)(?:: (?P<arguments>[\w ]+))? -->\n(?P<text>.*?)"
    r"<!-- end generated -->",
    re.DOTALL,
)


def with_generated_parts(page: str) -> str:
    """The text of a page, its generated parts made anew."""

    def part(match: re.Match[str]) -> str:
        head = match[0].partition("\n")[0]
        text = GENERATED[match["name"]](*(match["arguments"] or "").split())
        return f"{head}\n\n{text}\n\n<!-- end generated -->"

    return PART.sub(part, page)


_BLANK = "\n\n"
_ROLE = re.compile(r":(?:func|class|meth|mod):")  # docstrings are written for Sphinx


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(header)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def settings_table(model: type[BaseModel], leave_out: Iterable[str] = ()) -> str:
    """The fields of a model with their meaning: their descriptions, or the docstring's.

    Fields with one meaning share a line. The limits of numbers are in the message that refuses one.
    """
    schema = model.model_json_schema()["properties"]
    meanings = attributes_of(model.__doc__ or "")
    rows: dict[str, list[tuple[str, str]]] = {}
    for name, field in model.model_fields.items():
        if name not in set(leave_out):
            meaning = _cell(field.description or meanings[name]).replace("None:", "`null`:")
            meaning += _choices(schema[name], meaning)
            rows.setdefault(meaning, []).append((f"`{name}`", _default(field.default)))
    return table(
        ["setting", "default", "meaning"],
        (
            [", ".join(dict.fromkeys(part)) for part in zip(*fields, strict=True)] + [meaning]
            for meaning, fields in rows.items()
        ),
    )


def attributes_of(docstring: str) -> dict[str, str]:
    """What the section "Attributes" of a docstring has to each name."""
    section = docstring.partition("Attributes:\n")[2]
    found: dict[str, str] = {}
    for names, text in re.findall(r"^ {8}([\w, ]+): (.*?)(?=^ {8}\S|\Z)", section, re.M | re.S):
        for name in names.split(", "):
            found[name] = _cell(text)
    return found


def _cell(text: str) -> str:
    """Text on one line, fit for a table."""
    return _one_line(text).replace("|", r"\|")


def _one_line(text: str) -> str:
    return " ".join(text.replace("``", "`").split())


def _choices(schema: Mapping[str, Any], meaning: str) -> str:
    """The words that a setting may be, from its JSON schema, if its meaning lacks one."""
    parts = [schema, *schema.get("anyOf", ())]
    words = [f"`{word}`" for part in parts for word in part.get("enum", ())]
    return "" if all(word in meaning for word in words) else f" One of {', '.join(words)}."


def _default(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "`null`", True: "`true`", False: "`false`"}[value]
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def _walk(command: click.Command, name: str = "calibgraph") -> Iterable[tuple[str, click.Command]]:
    """All commands that do something, with their full names."""
    children = getattr(command, "commands", None)
    if children is None:
        yield name, command
        return
    for child, inner in children.items():
        yield from _walk(inner, f"{name} {child}")


def _command(name: str, command: click.Command, shared: list[list[str]]) -> str:
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    options = [p for p in command.params if p.param_type_name == "option"]
    usage = " ".join([name, *(p.metavar or p.name.upper() for p in arguments), "[options]"])
    rows = [[f"`{p.metavar or p.name.upper()}`", _cell(p.help or ""), ""] for p in arguments]
    rows += [_row(p) for p in options if _row(p)[:2] not in [row[:2] for row in shared]]
    also = [f"`{p.opts[0]}`" for p in options if _row(p)[:2] in [row[:2] for row in shared]]
    parts = [f"### {name}", _cell(command.help or ""), f"```text\n{usage}\n```"]
    parts += [table(_HEADER, rows)] if rows else []
    return "\n\n".join([*parts, *([f"Shared: {', '.join(also)}."] if also else [])])


def _row(option: click.Parameter) -> list[str]:
    """An option in a table."""
    return [_flags(option), _cell(option.help or ""), _shown_default(option)]


def _flags(option: click.Parameter) -> str:
    names = "`, `".join([*option.opts, *option.secondary_opts])
    flags = f"`{names} {option.metavar}`" if option.metavar else f"`{names}`"
    return flags.replace("|", r"\|")


def _shown_default(option: click.Parameter) -> str:
    shown = getattr(option, "show_default", False)
    return f"`{option.default}`" if shown and option.default not in (None, False) else ""


if __name__ == "__main__":
    _docs = Path(__file__).parent
    for _page in (_docs.parent / "README.md", *sorted(_docs.glob("*.md"))):
        _page.write_text(with_generated_parts(_page.read_text("utf-8")), "utf-8")
