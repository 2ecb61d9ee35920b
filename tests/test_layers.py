"""Imports flow one way, and importing the package is cheap."""

import ast
import functools
import graphlib
import importlib
import pathlib

import pytest

import hybridjax

from .sessions import run_python


ROOT = pathlib.Path(hybridjax.__file__).parent
# Each entry imports only from entries before it, and from itself.
LAYERS = (
    "_core errors systems mechanics models linear engine orbits sections experiments "
    "identify scale fitting designs recordings plants testing plot io convert apps __main__"
).split()


@functools.cache
def imported(file):
    """What a file imports of hybridjax, at its top or inside of functions, as paths."""
    package = file.relative_to(ROOT).parts[:-1]
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.ImportFrom):
            module = tuple(node.module.split(".")) if node.module else ()
            if node.level:
                up = node.level - 1
                module = package[: len(package) - up] + module
            elif module[:1] == ("hybridjax",):
                module = module[1:]
            else:
                continue
            found += [(*module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [tuple(alias.name.split(".")) for alias in node.names]
            found += [
                name[1:] for name in names if name[0] == "hybridjax" and len(name) > 1
            ]
    return found


FILES = sorted(f for f in ROOT.rglob("*.py") if f.name != "__init__.py")
FOLDERS = sorted({f.parent for f in ROOT.rglob("*.py")})


def test_imports_flow_one_way():
    for file in FILES:
        own = file.relative_to(ROOT).parts[0].removesuffix(".py")
        assert own in LAYERS, f"{own} has no place in the layers yet"
        for other, *_ in imported(file):
            if other in LAYERS:
                assert LAYERS.index(other) <= LAYERS.index(own), (
                    f"{file} imports from {other}"
                )


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: str(f.relative_to(ROOT)))
def test_folders(folder):
    """Imports flow one way between its files and folders, each with all that is in it. No public
    name is also a module, which would make it either of them, by chance."""
    where = folder.relative_to(ROOT).parts
    depth = len(where)
    needs = {}
    for file in folder.rglob("*.py"):
        own = file.relative_to(folder).with_suffix("").parts[0]
        others = {
            path[depth]
            for path in imported(file)
            if path[:depth] == where and path[depth:]
        }
        new = others - {own}
        needs.setdefault(own, set()).update(new)
    tuple(graphlib.TopologicalSorter(needs).static_order())
    modules = {f.stem for f in folder.iterdir() if f.suffix == ".py" or f.is_dir()}
    stub = folder / "__init__.pyi"
    if stub.exists():
        names = set()
        for statement in ast.parse(stub.read_text()).body:
            if isinstance(statement, ast.ImportFrom) and statement.module is not None:
                names |= {alias.asname for alias in statement.names}
        assert not names & modules


def test_importing_hybridjax_does_not_import_jax():
    code = (
        "import sys, hybridjax; names = dir(hybridjax); hybridjax.__version__; "
        "assert {'simulate', 'find_limit_cycle', 'linearize', 'models'} <= set(names), names; "
        "assert not {'jax', 'numpy', 'matplotlib'} & set(sys.modules), 'heavy imports'"
    )
    run_python("-c", code)


def test_public_names_resolve_and_have_docstrings():
    stubs = (
        ".".join(f.parent.relative_to(ROOT.parent).parts) for f in ROOT.rglob("*.pyi")
    )
    for namespace in map(importlib.import_module, stubs):
        for name in namespace.__all__:
            assert getattr(namespace, name).__doc__, name


def test_a_name_that_is_spelled_otherwise_is_suggested():
    with pytest.raises(AttributeError, match="did you mean hj.linearize"):
        hybridjax.linearise  # noqa: B018
