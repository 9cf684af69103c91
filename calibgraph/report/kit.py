"""The kit of all pages: their frame, styles, scripts and macros."""

from functools import cache

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from calibgraph.errors import printable


def load_template(name: str, package: str = "calibgraph.report", folder: str = "") -> Template:
    """A page's template, which may use ``base.html.j2`` and ``macros.html.j2`` of the report."""
    return _environment(package, folder).get_template(name)


def _seen(value: object) -> object:
    """Texts of others without characters that are not seen; markup is ours."""
    return printable(value) if type(value) is str else value


@cache
def _environment(package: str, folder: str) -> Environment:
    loaders = [PackageLoader(package, folder), PackageLoader("calibgraph.report", "")]
    return Environment(
        loader=ChoiceLoader(loaders),
        autoescape=True,
        finalize=_seen,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
