"""Former spellings of options: accepted for one release, and not shown in the help."""

from collections.abc import Callable, Iterator, Mapping, Sequence


def _unchanged(value: str) -> str:
    return value


def _metres_of_centimetres(value: str) -> str:
    """The number in metres; what is no number is left for the parser to refuse."""
    try:
        return repr(float(value) / 100.0)
    except ValueError:
        return value


FORMER: Mapping[str, Mapping[str, tuple[str, Callable[[str], str]]]] = {
    "guess": {"--data": ("--dataset", _unchanged)},
    "import": {
        "--relative-sigma-deg": ("--tie-deg", _unchanged),
        "--relative-sigma-cm": ("--tie-m", _metres_of_centimetres),
    },
    "train": {"--settings": ("--config", _unchanged)},
}
"""Per command and former option: the present one, and its value from the former one's."""


def with_present_options(arguments: Sequence[str]) -> Iterator[str]:
    """The words of a command line, with present options in place of former ones."""
    former = FORMER.get(next((word for word in arguments if word in FORMER), ""), {})
    convert: Callable[[str], str] = _unchanged
    for word in arguments:
        option, equals, value = word.partition("=")
        present, converted = former.get(option, (option, _unchanged))
        if equals:
            yield f"{present}={converted(value)}"
        else:
            yield convert(present)
        convert = converted if not equals else _unchanged
