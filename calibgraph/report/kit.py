"""The kit of all pages: their frame, styles, scripts and macros."""

from functools import cache

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, Template

from calibgraph.errors import printable


@cache
def page_template(package: str) -> Template:
    """A package's page, which may use ``base.html.j2`` and ``macros.html.j2`` of the report."""
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(each, "") for each in (package, "calibgraph.report")]),
        autoescape=True,
        # Texts of others without characters that are not seen; markup is ours.
        finalize=lambda value: printable(value) if type(value) is str else value,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2")
