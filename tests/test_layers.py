"""Imports flow one way, and importing the package is cheap."""

import ast
import pathlib
import subprocess
import sys

import pytest

import hybridjax


ROOT = pathlib.Path(hybridjax.__file__).parent
# Each entry imports only from entries before it, and from itself.
LAYERS = [
    "errors",
    "_core",
    "systems",
    "models",
    "linear",
    "engine",
    "sections",
    "orbits",
    "maps",
    "experiments",
    "identify",
    "fitting",
    "recordings",
    "testing",
    "plot",
    "io",
    "apps",
    "__main__",
]


def imported(file):
    """Parts of hybridjax that a file imports, at its top or inside of functions."""
    package = file.relative_to(ROOT).parts[:-1]
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - (node.level - 1)]
            parts = (*base, *(node.module or "").split(".")) if node.module else base
            yield from [parts[0]] if parts else [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("hybridjax"):
            parts = node.module.split(".")[1:]
            yield from parts[:1] or [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            yield from [name[1] for name in names if name[0] == "hybridjax" and len(name) > 1]


FILES = sorted(f for f in ROOT.rglob("*.py") if f.name != "__init__.py")


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_flow_one_way(file):
    own = file.relative_to(ROOT).parts[0].removesuffix(".py")
    assert own in LAYERS, f"{own} has no place in the layers yet"
    for other in imported(file):
        if other in LAYERS:
            assert LAYERS.index(other) <= LAYERS.index(own), f"{own} imports from {other}"


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_files_stay_small(file):
    assert len(file.read_text().splitlines()) <= 400


def test_importing_hybridjax_does_not_import_jax():
    code = (
        "import sys, hybridjax; names = dir(hybridjax); hybridjax.__version__; "
        "assert {'simulate', 'find_limit_cycle', 'linearize', 'models'} <= set(names), names; "
        "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'heavy imports'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_public_names_resolve_and_have_docstrings():
    for name in hybridjax.__all__:
        thing = getattr(hybridjax, name)
        assert thing.__doc__, name
