"""Links and commands of the documentation."""

from __future__ import annotations

from functools import cache, partial

import click
from typer.main import get_command

from calibgraph.cli.app import app

program = cache(partial(get_command, app))  # it takes a tenth of a second to build


def resolve(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that some words call, and the words after it."""
    command: click.Command = program()
    while children := getattr(command, "commands", None):
        assert words and words[0] in children, f"{words}: no such command"
        command, words = children[words[0]], words[1:]
    return command, words


def takes(command: click.Command, words: list[str]) -> bool:
    """Whether the words are as many arguments as the command needs, options and values apart."""
    wanted = [p for p in command.params if p.param_type_name == "argument" and p.required]
    with_value = {
        name
        for p in command.params
        for name in p.opts
        if p.param_type_name == "option" and not getattr(p, "is_flag", False)
    }
    given, skip = 0, False
    for word in words:
        if skip or word.startswith("--"):
            skip = word in with_value
        else:
            given += 1
    return given >= len(wanted)
