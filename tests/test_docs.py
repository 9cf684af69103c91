"""README and pages: links, commands, generated parts; their examples, and the tutorial, run."""

import re
import shlex
import shutil
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import click
import numpy as np
import pytest
from typer.main import get_command

import calibgraph
from calibgraph.cli.app import app
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.simulation.world import INSTALL_LIBRARIES
from docs.tables import API, PART, with_generated_parts
from docs.transcripts import BLOCK, PAGE, run, shown
from tests.conftest import ROOT, SAMPLE, require_near, require_poses

PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("[bd]*/README.md")])
NOTES = sorted(ROOT.glob("benchmarks/notes/*.md"))
READERS_PAGES = [page for page in PAGES if page.name != "CHANGELOG.md"]
OF_ALL = ("--help", "--version", "--debug")


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
            yield shlex.split(re.split(r" [|<>#] ", found[1])[0])


program = cache(partial(get_command, app))  # it takes a tenth of a second to build


def resolve(words: list[str]) -> tuple[click.Command, list[str]]:
    """The command that some words call, and the words after it."""
    command: click.Command = program()
    while children := getattr(command, "commands", None):
        assert words and words[0] in children, f"{words}: no such command"
        command, words = children[words[0]], words[1:]
    return command, words


@pytest.mark.parametrize("page", READERS_PAGES, ids=name_of)
def test_commands_and_options_exist(page: Path) -> None:
    for words in command_lines(page):
        command, rest = resolve([word for word in words if word not in OF_ALL])
        values, _, _ = command.make_parser(click.Context(command)).parse_args(rest)
        wanted = [p for p in command.params if p.param_type_name == "argument" and p.required]
        assert all(values.get(argument.name) for argument in wanted), words


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


def example(page: str) -> str:
    """The one block of Python on a page."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)
    return str(block)


FIRST = example("README.md")
ARRAYS = example("docs/library.md")
OWN_MATCHER = example("docs/matchers.md")
TRACKER = example("docs/tracking.md")
TRUTH = calibgraph.load_rig(SAMPLE / "reference.yaml")


def arrays_of_sample() -> dict[str, object]:
    """What the example with arrays takes from the reader's program."""
    dataset = calibgraph.load_dataset(SAMPLE)
    cameras = {"left": dataset.rig.cameras["left"]}
    return {
        "clouds": [frame.load_cloud() for frame in dataset.frames],
        "images": {n: [f.load_image(n, c) for f in dataset.frames] for n, c in cameras.items()},
        "size": (640, 360),
        "K": {name: camera.matrix_px for name, camera in cameras.items()},
        "distortion": {name: camera.distortion for name, camera in cameras.items()},
        "T_guess": {name: camera.T_camera_lidar for name, camera in cameras.items()},
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the examples are run."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "data").symlink_to(ROOT / "data")
    return folder


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> calibgraph.Calibration:
    """The sample as the README's example calibrates it, from 2 deg and 0.2 m: one camera.

    The tutorial calibrates all three.
    """
    folder, names = tmp_path_factory.mktemp("one"), dict[str, object]()
    sample = Path(shutil.copytree(SAMPLE, folder / "data" / "sample"))
    rig = calibgraph.load_rig(SAMPLE)
    calibgraph.Rig(cameras={"left": rig.cameras["left"]}).save(sample / "rig.yaml")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(compile(FIRST, "README.md", "exec"), names)
    result = names["result"]
    assert isinstance(result, calibgraph.Calibration)
    assert (folder / "out" / "python" / "calibration.yaml").is_file()
    return result


def test_the_sample_is_calibrated(result: calibgraph.Calibration) -> None:
    """With exact truth, to the resolution of a 640 px image."""
    # 1 px is 0.12 deg
    require_near(result.rig, TRUTH, deg=0.12, cm=3)
    assert result.verdict.status == "PASS", result.verdict.reasons
    assert len(result.rounds) == len(LEVELS) - 3  # the search has done the first


@pytest.mark.slow
def test_arrays_give_the_numbers_of_the_folder(
    monkeypatch: pytest.MonkeyPatch, result: calibgraph.Calibration, folder: Path
) -> None:
    monkeypatch.chdir(folder)
    names = arrays_of_sample()
    exec(compile(ARRAYS, "library.md", "exec"), names)
    same = names["result"]
    assert isinstance(same, calibgraph.Calibration)
    require_poses(same.T_camera_lidar, result.T_camera_lidar, atol=1e-9)


@pytest.mark.usefixtures("no_image_checks")
def test_a_matcher_and_a_tracker_as_in_the_examples(
    monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.chdir(folder)
    names: dict[str, object] = {"calibgraph": calibgraph, "your_matches": true_matches}
    exec(compile(OWN_MATCHER, "matchers.md", "exec"), names)
    table = calibgraph.load_correspondences(folder / "matches.parquet")
    assert len(np.unique(table.frame)) == 6
    result = names["result"]
    assert isinstance(result, calibgraph.Calibration)
    for error in calibgraph.evaluate(result.rig, TRUTH).cameras.values():
        assert error.rotation_error_deg < 0.1
    names["frame_tables"] = [table.select(table.frame == frame) for frame in range(6)]
    exec(compile(TRACKER, "tracking.md", "exec"), names)
    update = names["update"]
    assert isinstance(update, calibgraph.Update)
    assert update.verdicts["left"].status in ("PASS", "WARN")
    assert calibgraph.IncrementalCalibrator.load("out/tracker").frame == 5


def true_matches(
    image: np.ndarray, cloud: np.ndarray, camera: calibgraph.Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A matcher with errors of half a pixel about the truth."""
    (name,) = [
        n
        for n, c in calibgraph.load_rig(SAMPLE).cameras.items()
        if np.array_equal(c.T_camera_lidar, camera.T_camera_lidar)
    ]
    T = TRUTH.T_camera_lidar[name]
    rng = np.random.default_rng(len(cloud))
    rows = rng.permutation(len(cloud))[:3000]
    points = cloud[rows, :3].astype(np.float64)
    pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
    seen = valid & camera.in_image(pixels)
    noisy = pixels[seen] + rng.normal(0, 0.5, (np.count_nonzero(seen), 2))
    return noisy, rows[seen], np.ones(len(noisy))


def test_the_rig_example_is_a_rig(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "files.md").read_text()
    text = re.search(r"(format: calibgraph-rig/1\n.*?\n)relative_poses", page, re.DOTALL)
    (tmp_path / "rig.yaml").write_text(text[1])
    assert list(calibgraph.load_rig(tmp_path / "rig.yaml").cameras) == ["front"]


_NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?")
_SECONDS = re.compile(r"\d+(?:\.\d+)? s;")
CALIBRATE = "calibrate data/sample --out out/sample"


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The output of every command of the tutorial, run in order."""
    folder = tmp_path_factory.mktemp("tutorial")
    (folder / "data").symlink_to(ROOT / "data")
    commands = [block["command"] for block in BLOCK.finditer(PAGE.read_text("utf-8"))]
    return {command: run(command, folder) for command in commands}


@pytest.mark.slow
@pytest.mark.ci
def test_the_tutorial_shows_what_the_program_prints(printed: dict[str, str]) -> None:
    for block in BLOCK.finditer(PAGE.read_text("utf-8")):
        output = shown(printed[block["command"]], block["output"])
        require_alike(block["output"].splitlines(), output.splitlines())


@pytest.mark.slow
@pytest.mark.ci
def test_the_readme_shows_the_first_lines_that_the_program_prints(printed: dict[str, str]) -> None:
    (shown,) = re.findall(r"```text\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = shown.splitlines()
    require_alike(lines, printed[CALIBRATE].splitlines()[: len(lines)])


def require_alike(shown: list[str], printed: list[str]) -> None:
    """Same words in same lines; numbers within a tenth, or within 0.1 deg, cm or px."""
    assert len(shown) == len(printed), "\n".join(printed)
    for line, other in zip(shown, printed, strict=True):
        line, other = _SECONDS.sub("", line), _SECONDS.sub("", other)  # noqa: PLW2901
        words = (re.split(r"\s+", _NUMBER.sub("#", text.strip())) for text in (line, other))
        assert next(words) == next(words), f"{line}\n{other}"
        pairs = zip(_NUMBER.findall(line), _NUMBER.findall(other), strict=True)
        for wanted, found in pairs:
            assert float(found) == pytest.approx(float(wanted), rel=0.1, abs=0.1), line


def test_the_tutorial_has_output_for_every_command() -> None:
    blocks = [*BLOCK.finditer(PAGE.read_text("utf-8"))]
    assert len(blocks) == Path(PAGE).read_text("utf-8").count("$ calibgraph ")
    assert all(block["output"].strip() for block in blocks)


@pytest.mark.parametrize("file", [".ci/run", ".github/workflows/ci.yml", "docs/data.md"])
def test_libraries_of_open3d_are_the_same_everywhere(file: str) -> None:
    lists = re.findall(r"libusb-1.0-0[a-z0-9 .-]*", (ROOT / file).read_text())
    named = INSTALL_LIBRARIES.removeprefix("apt-get install ")
    assert {each.removesuffix(" chromium").strip() for each in lists} == {named}
