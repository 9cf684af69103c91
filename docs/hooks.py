"""What `mkdocs build` adds to the pages: the API, formulas as MathML, pictures."""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from tables import API, PART

import calibgraph

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ("data/overlay.webp", "data/track.png")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pictures that the README shows too."""
    for name in PICTURES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Full descriptions in place of the tables of the API; pictures where the site has them."""
    return PART.sub(_described, markdown).replace("](../data/", "](data/")


def _described(part: re.Match[str]) -> str:
    """A generated part; of the API, what mkdocstrings makes of every name."""
    if part["name"] != "api":
        return part["text"]
    return "\n\n".join(f"::: {_path(name)}" for name in API[part["arguments"]].split())


def _path(name: str) -> str:
    """Of a public name; where its module has the same name, mkdocstrings would take the module."""
    module = getattr(calibgraph, name).__module__
    return f"{module}.{name}" if module.endswith(f".{name}") else f"calibgraph.{name}"


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn formulas into MathML, which browsers show without a script, and wrap tables."""
    content = _ROLE.sub("", _FORMULA.sub(_to_mathml, content))
    return content.replace("<table>", '<div class="wide"><table>').replace(
        "</table>", "</table></div>"
    )


_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[\[(](?P<latex>.*?)\\[\])]</(?P=tag)>', re.DOTALL
)


_ROLE = re.compile(r":(?:func|class|meth|mod):(?=<code>)")  # docstrings are written for Sphinx


def _to_mathml(match: re.Match[str]) -> str:
    display = "block" if match["tag"] == "div" else "inline"
    return convert(html.unescape(match["latex"]).strip(), display=display)
