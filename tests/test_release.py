"""What is said twice, for pip and for conda, is the same."""

import re
import tomllib

import pytest

from .sessions import ROOT


RECIPE = ROOT / "conda/recipe.yaml"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CALLED = {"matplotlib-base": "matplotlib"}  # what conda calls otherwise


def test_the_conda_recipe_requires_what_pyproject_does():
    run = RECIPE.read_text().partition("  run:\n")[2].partition("\ntests:")[0]
    lines = re.findall(r"^    - (\S+) (\S+)$", run, re.MULTILINE)  # (python's has blanks)
    required = {CALLED.get(name, name): bounds for name, bounds in lines}
    names = (re.fullmatch(r"([\w-]+)(.*)", line).groups() for line in PROJECT["dependencies"])
    assert required == dict(names)


def test_the_conda_recipe_has_the_version_and_renders():
    assert f'version: "{PROJECT["version"]}"' in RECIPE.read_text()
    rattler = pytest.importorskip("rattler_build", reason="pip install py-rattler-build renders it")
    variants = {"python_min": [PROJECT["requires-python"].removeprefix(">=")]}
    recipe = rattler.Stage0Recipe.from_file(RECIPE)
    (rendered,) = recipe.render(rattler.VariantConfig(variants), rattler.RenderConfig())
    made = rendered.recipe
    assert (made.package.name, str(made.package.version)) == ("hybridjax", PROJECT["version"])
