"""The package as it is installed: what a clone's folder cannot hide, and what sdist and wheel hold."""

import importlib
import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

import hhtjax
from hhtjax.primitives import compat

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
BACKEND = PROJECT["build-system"]["build-backend"]


@pytest.fixture
def built(tmp_path, monkeypatch):
    """A function kind -> path of the "editable", "wheel" or "sdist" that the declared backend makes of this folder."""
    backend = importlib.import_module(BACKEND)
    monkeypatch.chdir(ROOT)
    return lambda kind: tmp_path / getattr(backend, f"build_{kind}")(str(tmp_path))


def test_the_folder_of_a_clone_does_not_hide_an_editable_install(built, tmp_path):
    """`git clone .../hhtjax; pip install -e hhtjax; python -c "import hhtjax; hhtjax.System"`, in one folder.

    The clone's folder has no `__init__.py`: it is a namespace package to whom looks for `hhtjax` there first, and that
    comes before what is found by a finder of the installer's own, though not before a path in a .pth file.
    """
    site, parent = tmp_path / "site", tmp_path / "parent"
    (parent / "hhtjax" / "hhtjax").mkdir(parents=True)
    zipfile.ZipFile(built("editable")).extractall(site)
    find = f"import importlib.util as i, site; site.addsitedir({str(site)!r}); print(i.find_spec('hhtjax').origin)"
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    only_this = [sys.executable, "-S", "-c", find]  # -S: not what else is installed here
    found = subprocess.run(only_this, cwd=parent, env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == str(ROOT / "hhtjax" / "__init__.py")


def test_the_wheel_is_the_package_and_nothing_else(built):
    names = zipfile.ZipFile(built("wheel")).namelist()
    files = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    ours = {str(path.relative_to(ROOT)) for path in (ROOT / "hhtjax").rglob("*") if path.suffix in (".py", ".typed")}
    assert files == ours
    assert "hhtjax/py.typed" in files


@pytest.mark.slow
def test_the_sdist_holds_what_the_tests_read(built):
    with tarfile.open(built("sdist")) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = [path for folder in ("hhtjax", "experiments", "tests") for path in (ROOT / folder).rglob("*")]
    ours = {str(path.relative_to(ROOT)) for path in tracked if path.suffix in (".py", ".json", ".md", ".png", ".c")}
    ours = {name for name in ours if "experiments/output" not in name}
    assert ours <= names
    assert {"pyproject.toml", "README.md", "CHANGELOG.md", "LICENSE", ".ci/run"} <= names


def test_the_range_of_jax_is_told_as_it_is():
    (lowest,) = [x for x in PROJECT["project"]["dependencies"] if x.startswith("jax>=")]
    first, last = lowest.removeprefix("jax>="), ".".join(map(str, compat.NEWEST))
    assert f"Kernels are made with JAX {first} to {last}." in hhtjax.xla.__doc__
    assert f"JAX from {first} to {last}." in (ROOT / "CONTRIBUTING.md").read_text()
