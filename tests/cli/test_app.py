"""One line for bad input, exit codes, and a fast ``--help``."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from calibgraph import Rig, load_rig
from calibgraph.cli import app
from tests.cli.conftest import error_line
from tests.conftest import ROOT, SAMPLE, Call


def test_a_truncated_image_writes_nothing(call: Call, tmp_path: Path) -> None:
    sample = Path(shutil.copytree(SAMPLE, tmp_path / "sample"))
    broken = sample / "cameras" / "left" / "000005.jpg"
    broken.write_bytes(broken.read_bytes()[:9000])
    message = error_line(*call("calibrate", sample, "--out", tmp_path / "out"))
    assert "000005.jpg" in message
    assert "truncated" in message
    assert not (tmp_path / "out").exists()


def test_ctrl_c_is_one_line(monkeypatch: pytest.MonkeyPatch, call: Call) -> None:
    def interrupt(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("calibgraph.load_rig", interrupt)
    code, out, err = call("perturb", SAMPLE, "--out", "never.yaml")
    assert (code, out, err) == (130, "", "calibgraph: interrupted\n")


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            TypeError("in\nlines"),
            "(TypeError: in lines); please report it with the output of "
            f"calibgraph --debug evaluate {SAMPLE} {SAMPLE}",
        ),
        (MemoryError("1 TiB"), "not enough memory (1 TiB)"),
    ],
)
def test_a_crash_is_one_line_and_no_fail(
    error: Exception, message: str, monkeypatch: pytest.MonkeyPatch, call: Call
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("calibgraph.load_rig", fail)
    code, out, err = call("evaluate", SAMPLE, SAMPLE)
    assert (code, out) == (2, "")
    assert message in err and err.count("\n") == 1


def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    missing = str(tmp_path / "nothing.yaml")
    monkeypatch.setattr(sys, "argv", ["calibgraph", "--debug", "evaluate", missing, missing])
    with pytest.raises(Exception, match="no such file"):
        app.main()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['calibgraph', '--help']\n"
        "from calibgraph.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'gtsam', 'numpy', 'numba', 'cv2', 'scipy', 'pyarrow', 'pydantic', 'jinja2'}\n"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for command in (
        "calibrate", "match", "solve", "report", "evaluate", "perturb", "export", "rig",
        "simulate", "track",
    ):  # fmt: skip
        assert command in done.stdout


WITHOUT_EXTRAS = """
import sys, tomllib
from importlib.metadata import packages_distributions
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
extras = {name: of for name, of in project["optional-dependencies"].items()
          if name not in ("docs", "test")}
names = {word.partition(">")[0].lower() for of in extras.values() for word in of}
hidden = {package for package, sources in packages_distributions().items()
          if {each.lower() for each in sources} <= names}
assert {"fastapi", "open3d", "torch"} <= hidden

class Hidden:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {name!r}")

sys.meta_path.insert(0, Hidden())
from calibgraph.cli.app import main
for line in sys.argv[1:]:
    sys.argv = ["calibgraph", *line.split()]
    try:
        main()
    except SystemExit as done:
        assert not done.code, line
"""


@pytest.mark.ci
@pytest.mark.slow
def test_commands_need_no_package_of_an_extra(tmp_path: Path) -> None:
    """Those that only extras name cannot be imported."""
    lines = (
        f"evaluate {SAMPLE}/rig.yaml {SAMPLE}/reference.yaml",
        f"rig {SAMPLE}/rig.yaml",
        f"doctor {SAMPLE} --frames 0:1",
        f"calibrate {SAMPLE} --rig {tmp_path}/one.yaml --frames 0:1 --search-deg 0 --search-m 0 "
        f"--out {tmp_path}/out",
    )
    one = {"front_left": load_rig(SAMPLE / "reference.yaml").cameras["front_left"]}
    Rig(cameras=one).save(tmp_path / "one.yaml")
    words = [sys.executable, "-c", WITHOUT_EXTRAS, *lines]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
