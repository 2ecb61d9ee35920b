"""What is said twice is the same, and builds of jax that compute wrong numbers are seen."""

import os
import re
import shutil
import tomllib

import pytest

from .sessions import ROOT, run_python


RECIPE = ROOT / "conda/recipe.yaml"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CALLED = {"matplotlib-base": "matplotlib"}  # what conda calls otherwise


def test_the_conda_recipe_requires_what_pyproject_does():
    run = RECIPE.read_text().partition("  run:\n")[2].partition("\ntests:")[0]
    lines = re.findall(
        r"^    - (\S+) (\S+)$", run, re.MULTILINE
    )  # (python's has blanks)
    required = {CALLED.get(name, name): bounds for name, bounds in lines}
    names = (
        re.fullmatch(r"([\w-]+)(.*)", line).groups() for line in PROJECT["dependencies"]
    )
    assert required == dict(names)


def test_the_conda_recipe_has_the_version_and_renders():
    assert f'version: "{PROJECT["version"]}"' in RECIPE.read_text()
    rattler = pytest.importorskip(
        "rattler_build", reason="pip install py-rattler-build renders it"
    )
    variants = {"python_min": [PROJECT["requires-python"].removeprefix(">=")]}
    recipe = rattler.Stage0Recipe.from_file(RECIPE)
    (rendered,) = recipe.render(rattler.VariantConfig(variants), rattler.RenderConfig())
    made = rendered.recipe
    assert (made.package.name, str(made.package.version)) == (
        "hybridjax",
        PROJECT["version"],
    )


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
n = 16385
rows = np.zeros((n, 3))
rows[:, 0] = np.arange(n)
lengths = lambda rows: jax.vmap(lambda row: jnp.sum((jnp.eye(3) @ row) ** 2))(rows)
np.testing.assert_array_equal(lengths(rows), np.arange(n) ** 2.0)
np.testing.assert_array_equal(jax.jit(lengths)(rows), np.arange(n) ** 2.0)
"""


def test_batched_products_followed_by_a_reduction():
    """jax issue 39103: on CPU, jax 0.10.2 silently returns 267911424 for the last of these."""
    kept = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    run_python("-c", PRODUCTS, env=kept | {"JAX_ENABLE_X64": "1"})
