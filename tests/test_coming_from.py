"""The page for those who come from other packages runs; where a package is missing, its part is skipped."""

import re
from pathlib import Path

import jax
import pytest

PAGE = (Path(__file__).parents[1] / "experiments" / "notebooks" / "coming_from.md").read_text()
FOUND = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
BLOCKS = dict(zip(("hhtjax", "scipy", "diffrax", "mujoco"), FOUND, strict=True))


@pytest.fixture(scope="module")
def namespace():
    known = {}
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        exec(compile(BLOCKS["hhtjax"], "coming_from.md", "exec"), known)
    return known


@pytest.mark.slow
@pytest.mark.parametrize("package", ["scipy", "diffrax", "mujoco"])
@pytest.mark.filterwarnings("ignore")  # theirs
def test_each_package_agrees(package, namespace):
    pytest.importorskip(package)
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        exec(compile(BLOCKS[package], "coming_from.md", "exec"), dict(namespace))
