"""The wheel and the source distribution: what is in them, and that the wheel runs where nothing else was installed."""

import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("hatchling")

ROOT = Path(__file__).parent.parent
NEEDED = (
    "data/LICENSE-square-drop",
    "data/square_drops.npz",
    "view/player.js",
    "view/three/three.min.js",
    "view/three/LICENSE-three",
)
RUN = "import diffrigid; print(diffrigid.__file__); diffrigid.scene({'a': diffrigid.Body(diffrigid.Disc(radius=1.0), mass=1.0, x=(0.0, 0.0))})"


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The folder with both files."""
    out = tmp_path_factory.mktemp("dist")
    command = "import hatchling.builders.{0} as b; print(next(b.{1}(r'{2}').build(directory=r'{3}')))"
    for module, kind in (("wheel", "WheelBuilder"), ("sdist", "SdistBuilder")):
        text = command.format(module, kind, ROOT, out)
        subprocess.run([sys.executable, "-c", text], check=True, capture_output=True)
    return out


def test_nothing_is_missing(built):
    wheel = zipfile.ZipFile(next(built.glob("*.whl"))).namelist()
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        source = [name.split("/", 1)[-1] for name in archive.getnames()]
    git = shutil.which("git")
    listed = git and subprocess.run([git, "ls-files", "diffrigid"], cwd=ROOT, capture_output=True, text=True).stdout
    for name in (listed or "").split() or [f"diffrigid/{name}" for name in NEEDED]:
        assert name in wheel and name in source
    assert {f"diffrigid/{name}" for name in NEEDED} <= set(wheel)
    assert any(name.endswith("licenses/LICENSE") for name in wheel) and {"LICENSE", "README.md"} <= set(source)


def test_the_wheel_runs_alone(built, tmp_path):
    """In an environment that has only its dependencies, those of this one."""
    venv.create(tmp_path / "env", with_pip=True)
    python = tmp_path / "env" / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    install = [python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", next(built.glob("*.whl"))]
    subprocess.run(install, check=True, capture_output=True)
    where = subprocess.run(
        [python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    # After its own packages, and without what makes an editable installation of this one.
    (Path(where) / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    made = subprocess.run([python, "-c", RUN], check=True, capture_output=True, text=True, cwd=tmp_path)
    assert Path(made.stdout.strip()).is_relative_to(where)
    shown = subprocess.run(
        [python, "-m", "diffrigid", "--help"], check=True, capture_output=True, text=True, cwd=tmp_path
    )
    assert "usage" in shown.stdout
