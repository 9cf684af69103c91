"""The benchmarks can be called and are listed, and those of speed measure what they state."""

from importlib import import_module

import pytest

from benchmarks.speed import gate
from tests.conftest import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for folder in ("benchmarks", "tools")
    for path in (ROOT / folder).rglob("*.py")
    if path.stem != "__init__"
)
COMMANDS = [name for name in MODULES if '__name__ == "__main__"' in
            (ROOT / (name.replace(".", "/") + ".py")).read_text()]  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_every_benchmark_and_tool_can_be_imported(name: str) -> None:
    import_module(name)


def test_the_readme_lists_every_benchmark_and_tool() -> None:
    text = (ROOT / "benchmarks" / "README.md").read_text()
    for name in COMMANDS:
        assert f"| `{name.removeprefix('benchmarks.').removesuffix('.__main__')}` |" in text


def test_the_gate_names_what_became_slower_than_the_release() -> None:
    former = {"solve / TRF": 0.1, "kernel / sgemm": 1.0, "gone": 1.0}
    found = {"solve / TRF": 0.124, "kernel / sgemm": 1.26, "new": 5.0}
    assert gate.slower(found, former) == ["kernel / sgemm"]
    text = gate.compare(found, former).text()
    assert "1.24" in text and "1.26" in text and "gone" not in text
