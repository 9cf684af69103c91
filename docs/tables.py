"""The generated parts of the pages, from the code itself.

    python -m docs.tables

writes them anew between the lines ``<!-- generated: NAME -->`` and ``<!-- end generated -->``.
"""

import inspect
import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
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

    return settings_list(Config, leave_out={"preset", "tracking"})


def tracking_settings() -> str:
    """The settings under ``tracking``."""
    from calibgraph.model.config import Tracking

    return settings_list(Tracking)


def presets() -> str:
    """The settings of the paper's presets, as far as they differ from the default."""
    from calibgraph.model.config import PRESETS, Config, preset

    default = Config().model_dump()
    lines = []
    for name in PRESETS:
        values = preset(name).model_dump(exclude={"preset"}).items()
        other = [f"`{key}: {_plain(each)}`" for key, each in values if each != default[key]]
        lines += [f"* `{name}`: {', '.join(other)}"] if other else []
    return "\n".join(lines)


def commands() -> str:
    """Every command with its arguments and options; those that several have alike, once."""
    from calibgraph.cli.app import app
    from calibgraph.cli.settings import RareSettings

    found = [*_walk(get_command(app))]
    lines = Counter((_name(p), _line(p)) for _, command in found for p in command.params)
    commonest = dict(sorted(lines, key=lines.__getitem__))  # of a name's lines the last counts
    shared = [line for (name, line), n in lines.items() if n > 1 and commonest[name] == line]
    return "\n\n".join(
        [
            "### Shared by several commands",
            "\n".join(shared),
            "### Keys of a config file",
            "Those of the [settings](settings.md), and rare ones that have no option:",
            settings_list(RareSettings),
            *(_command(name, command, shared) for name, command in found),
        ]
    )


def api(subject: str) -> str:
    """The public names of a subject; the site has their descriptions in its place."""
    return ", ".join(f"`{name}`" for name in API[subject].split())


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

_SHARED = "shared-by-several-commands"
API = {
    "judge": """
        calibrate solve load_config preset evaluate perturb check write_audit_report drift
        Calibration Residuals Verdict Check Config Evaluation PoseError Audit CameraAudit
        Drift
    """,
    "data": """
        load_dataset dataset_from_arrays cloud_from_message image_from_message
        camera_from_message load_rig load_correspondences concatenate
        load_camera_matches load_calibration diagnose import_rig export_calibration
        describe_rig write_rig_template guess_rig Rig Camera
        Intrinsics RelativePose Dataset Frame BagOptions Diagnosis Finding Correspondences
        CameraMatches RigGuess CameraGuess
    """,
    "matchers": """
        match_cameras with_surfaces warm_up_tracker run_fleet read_rows observe fit_fleet
        write_fleet_report Matcher StructureMatcher IncrementalCalibrator DurableCalibrator
        Update Event FleetModel
    """,
    "simulation": """
        simulate_street simulate_correspondences block_factor projection_factor
        camera_prior_factor relative_prior_factor relative_pose_factor MatcherErrors
        CalibrationError FileError RigError CorrespondenceError DatasetError
    """,
}
"""Public names by subject, in the order of ``docs/library.md``."""

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


_ROLE = re.compile(r":(?:func|class|meth|mod):")  # docstrings are written for Sphinx


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A Markdown table."""
    head = list(header)
    lines = [head, ["---"] * len(head), *(list(row) for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def settings_list(model: type[BaseModel], leave_out: Iterable[str] = ()) -> str:
    """The fields of a model, their defaults, and their meaning: descriptions, or the docstring's.

    Fields with one meaning share a line. The limits of numbers are in the message that refuses one.
    """
    schema = model.model_json_schema()["properties"]
    meanings = attributes_of(model.__doc__ or "")
    lines: dict[str, list[str]] = {}
    for name, field in model.model_fields.items():
        if name not in set(leave_out):
            meaning = _one_line(field.description or meanings[name]).replace("None:", "`null`:")
            meaning += _choices(schema[name], meaning)
            lines.setdefault(meaning, []).append(f"`{name}: {_plain(field.default)}`")
    return "\n".join(f"* {', '.join(fields)}: {meaning}" for meaning, fields in lines.items())


def attributes_of(docstring: str) -> dict[str, str]:
    """What the section "Attributes" of a docstring has to each name."""
    section = inspect.cleandoc(docstring).partition("Attributes:\n")[2]
    found: dict[str, str] = {}
    for names, text in re.findall(r"^ {4}([\w, ]+): (.*?)(?=^ {4}\S|\Z)", section, re.M | re.S):
        for name in names.split(", "):
            found[name] = _one_line(text)
    return found


def _one_line(text: str) -> str:
    """Docstrings and help as Markdown."""
    return " ".join(text.replace("``", "`").split())


def _choices(schema: Mapping[str, Any], meaning: str) -> str:
    """The words that a setting may be, from its JSON schema, if its meaning lacks one."""
    parts = [schema, *schema.get("anyOf", ())]
    words = [f"`{word}`" for part in parts for word in part.get("enum", ())]
    return "" if all(word in meaning for word in words) else f" One of {', '.join(words)}."


def _plain(value: object) -> object:
    """A value as YAML has it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return list(value) if isinstance(value, tuple) else value


def _walk(command: click.Command, name: str = "calibgraph") -> Iterable[tuple[str, click.Command]]:
    """All commands that do something, with their full names."""
    children = getattr(command, "commands", None)
    if children is None:
        yield name, command
        return
    for child, inner in children.items():
        yield from _walk(inner, f"{name} {child}")


def _command(name: str, command: click.Command, shared: Sequence[str]) -> str:
    usage = [name, *(_name(p) for p in command.params if p.param_type_name == "argument")]
    own = [_line(each) for each in command.params if _line(each) not in shared]
    also = [f"`{_name(each)}`" for each in command.params if _line(each) in shared]
    parts = [f"### {name}", f"`{' '.join(usage)} [options]`", _one_line(command.help or "")]
    parts += ["\n".join(own)] if own else []
    return "\n\n".join([*parts, *([f"[Shared](#{_SHARED}): {', '.join(also)}"] if also else [])])


def _line(parameter: click.Parameter) -> str:
    """An argument or an option in a list."""
    names = [_name(parameter), *parameter.opts[1:], *parameter.secondary_opts]
    option = parameter.param_type_name == "option"
    value = f" {parameter.metavar}" if option and parameter.metavar else ""
    shown = getattr(parameter, "show_default", False) and parameter.default not in (None, False)
    default = f" (default: `{parameter.default}`)" if option and shown else ""
    return f"* `{'`, `'.join(names)}{value}`: {_one_line(parameter.help or '')}{default}"


def _name(parameter: click.Parameter) -> str:
    if parameter.param_type_name == "option":
        return parameter.opts[0]
    return parameter.metavar or parameter.name.upper()


if __name__ == "__main__":
    _docs = Path(__file__).parent
    for _page in (_docs.parent / "README.md", *sorted(_docs.glob("*.md"))):
        _page.write_text(with_generated_parts(_page.read_text("utf-8")), "utf-8")
