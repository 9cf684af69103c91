"""Documents of the text formats: YAML, JSON and XML, read as mappings, written below comments."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from calibgraph.errors import FileError
from calibgraph.files import read_json, read_text
from calibgraph.yaml_text import parse_yaml_documents, yaml_text

YAML_SUFFIXES = (".yaml", ".yml")


def read_documents(path: Path) -> list[dict[str, Any]]:
    """The mappings of a file: several of a YAML file, as ``ros2 topic echo`` prints them."""
    if path.suffix.lower() in YAML_SUFFIXES:
        return parse_yaml_documents(re.sub(r"\A%YAML.*\n", "", read_text(path)), path)
    return [read_json(path)]


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file."""
    try:
        root: ElementTree.Element = fromstring(read_text(path), forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        raise FileError(path, f"is not a URDF or other XML: {error}") from error
    return root


def commented(lines: Iterable[str]) -> str:
    """Lines as a comment of YAML and of shells."""
    return "".join(f"# {line}\n" for line in lines)


def commented_yaml(statement: Iterable[str], content: dict[str, Any]) -> str:
    """YAML below its statement of direction."""
    return commented(statement) + yaml_text(content)


def commented_xml(statement: Iterable[str], root: ElementTree.Element) -> str:
    """XML below its statement of direction; two hyphens may not stand in its comments."""
    ElementTree.indent(root)
    lines = "\n".join(f"  {line}" for line in statement)
    while "--" in lines:
        lines = lines.replace("--", "- -")
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n{body}\n'
