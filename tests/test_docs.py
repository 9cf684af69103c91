"""README and pages: links lead somewhere, commands parse, Python compiles."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

import calibgraph
from docs.tables import API, PART, with_generated_parts
from tests.conftest import ROOT
from tests.docs_text import resolve, takes

PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("[bd]*/README.md")])
NOTES = sorted(ROOT.glob("benchmarks/notes/*.md"))
READERS_PAGES = [page for page in PAGES if page.name != "CHANGELOG.md"]
VALUES = ("--help", "--version", "--debug")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", [*PAGES, *NOTES], ids=name_of)
def test_links_lead_to_files_and_headings(page: Path) -> None:
    text = without_code(page.read_text())
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), f"{target}: no such file"
        if anchor and file.suffix == ".md":
            assert anchor in anchors_of(file), f"{target}: no such heading"


def without_code(text: str) -> str:
    """The text without blocks of code, in which brackets are no links."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)


def anchors_of(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", without_code(page.read_text()), flags=re.MULTILINE)
    words = (re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings)
    return {re.sub(r"\s", "-", heading) for heading in words}


def command_lines(page: Path) -> Iterator[list[str]]:
    """The words of every ``calibgraph ...`` in an indented or fenced block."""
    blocks = re.findall(r"^```(?!python|yaml).*?^```", page.read_text(), re.MULTILINE | re.DOTALL)
    lines = re.findall(r"^ {4}(.*)$", page.read_text(), re.MULTILINE)
    for line in [*lines, *(line for block in blocks for line in block.splitlines())]:
        found = re.search(r"(?:^|\| )calibgraph (.*)", line)
        if found:
            shell = re.split(r" [|<>] ", found[1].split("  #")[0])[0]
            yield shlex.split(shell)


@pytest.mark.parametrize("page", READERS_PAGES, ids=name_of)
def test_commands_and_options_exist(page: Path) -> None:
    for words in command_lines(page):
        command, rest = resolve(words)
        known = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
        for option in (word for word in rest if word.startswith("--")):
            assert option.partition("=")[0] in {*known, *VALUES}, f"{words}: {option}"
        assert takes(command, rest), f"{words}: arguments do not fit"


@pytest.mark.parametrize("page", READERS_PAGES, ids=name_of)
def test_python_blocks_compile(page: Path) -> None:
    for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
        compile(block, name_of(page), "exec")


def test_the_api_page_has_every_public_name() -> None:
    parts = PART.finditer((ROOT / "docs/library.md").read_text())
    listed = " ".join(API[part["arguments"]] for part in parts if part["name"] == "api").split()
    assert sorted(listed) == sorted(calibgraph.__all__)


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text()
    for page in ROOT.glob("docs/*.md"):
        assert f": {page.name}\n" in navigation, page.name


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_generated_parts_are_what_the_code_gives(page: Path) -> None:
    text = page.read_text()
    assert text == with_generated_parts(text), "run python -m docs.tables"
