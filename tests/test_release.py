"""Things that are written in two places are the same, and broken builds of jax are noticed."""

import os
import re
import shutil
import tomllib

import pytest

import hybridjax

from .sessions import ROOT, run_python


RECIPE = ROOT / "conda/recipe.yaml"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAMES_IN_CONDA = {"matplotlib-base": "matplotlib"}


def test_all_files_have_the_same_version():
    version = PROJECT["version"]
    assert hybridjax.__version__ == version, "hybridjax/__init__.py"
    assert f'version: "{version}"' in RECIPE.read_text(), "conda/recipe.yaml"
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {version}\n" in citation, "CITATION.cff"


def test_the_conda_recipe_requires_what_pyproject_does():
    section = RECIPE.read_text().partition("  run:\n")[2]
    run = section.partition("\ntests:")[0]
    # The line of Python has blanks inside, so that it does not match.
    lines = re.findall(r"^    - (\S+) (\S+)$", run, re.MULTILINE)
    recipe = {NAMES_IN_CONDA.get(name, name): bounds for name, bounds in lines}
    pyproject = {}
    for line in PROJECT["dependencies"]:
        name, bounds = re.fullmatch(r"([\w-]+)(.*)", line).groups()
        pyproject[name] = bounds
    assert recipe == pyproject


def test_the_conda_recipe_renders():
    rattler = pytest.importorskip(
        "rattler_build", reason="pip install py-rattler-build renders it"
    )
    oldest_python = PROJECT["requires-python"].removeprefix(">=")
    variants = rattler.VariantConfig({"python_min": [oldest_python]})
    recipe = rattler.Stage0Recipe.from_file(RECIPE)
    (rendered,) = recipe.render(variants, rattler.RenderConfig())
    package = rendered.recipe.package
    assert package.name == "hybridjax"
    assert str(package.version) == PROJECT["version"]


def test_the_tables_are_those_of_the_baseline(tmp_path):
    page = ROOT / "docs" / "benchmarks.md"
    copy = tmp_path / page.name
    shutil.copy(page, copy)
    code = (
        "import json, pathlib, sys; from tables import fill; "
        "fill(pathlib.Path(sys.argv[1]), json.loads(pathlib.Path('baseline.json').read_text()))"
    )
    run_python("-c", code, copy, cwd=ROOT / "benchmarks")
    assert copy.read_text() == page.read_text()


# In a process of its own, since tests are compiled with other options than users' programs.
PRODUCTS = """
import jax, jax.numpy as jnp, numpy as np

def squared_length(row):
    return jnp.sum((jnp.eye(3) @ row) ** 2)

lengths = jax.vmap(squared_length)
n = 16385
rows = np.zeros((n, 3))
rows[:, 0] = np.arange(n)
np.testing.assert_array_equal(lengths(rows), np.arange(n) ** 2.0)
np.testing.assert_array_equal(jax.jit(lengths)(rows), np.arange(n) ** 2.0)
"""


def test_batched_products_followed_by_a_reduction():
    """jax issue 39103: on CPU, jax 0.10.2 silently returns 267911424 for the last of these."""
    variables = os.environ.items()
    kept = {name: value for name, value in variables if name != "XLA_FLAGS"}
    run_python("-c", PRODUCTS, env=kept | {"JAX_ENABLE_X64": "1"})
