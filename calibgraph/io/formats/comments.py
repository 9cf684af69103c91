"""Comments and documents of the text formats."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any
from xml.etree import ElementTree

from calibgraph.yaml_text import yaml_text


def commented(lines: Iterable[str]) -> str:
    """Lines as a comment of YAML and of shells."""
    return "".join(f"# {line}\n" for line in lines)


def commented_yaml(statement: Iterable[str], content: dict[str, Any]) -> str:
    """YAML below its statement of direction."""
    return commented(statement) + yaml_text(content)


def stated_json(statement: Iterable[str], content: dict[str, Any]) -> str:
    """JSON, which has no comments, with the statement of direction under its first key."""
    stated = {"calibgraph_export": list(statement), **content}
    return json.dumps(stated, indent=2, allow_nan=False) + "\n"


def commented_xml(statement: Iterable[str], root: ElementTree.Element) -> str:
    """XML below its statement of direction; two hyphens may not stand in its comments."""
    ElementTree.indent(root)
    lines = "\n".join(f"  {line}" for line in statement)
    while "--" in lines:
        lines = lines.replace("--", "- -")
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n{body}\n'
