"""Public names: where they are, which words they use, and that earlier ones lead to them."""

import ast
import importlib
import inspect
import pickle
import types
import typing
from collections import Counter

import cloudpickle
import numpy as np
import pytest

import hybridjax as hj
from hybridjax._core import public as tables
from hybridjax._core.boundary.containers import Names
from hybridjax._core.boundary.kinds import Probability

from .sessions import ROOT
from .test_typing import public


NAMESPACES = sorted(f.parent.name for f in (ROOT / "hybridjax").glob("*/__init__.pyi"))


def members(namespace):
    """Public functions and classes of a module, by name."""
    pairs = ((name, getattr(namespace, name)) for name in namespace.__all__)
    return {x: thing for x, thing in pairs if not isinstance(thing, types.ModuleType)}


def all_members():
    found = [(f"hj.{name}", thing) for name, thing in members(hj).items()]
    for name in NAMESPACES:
        namespace = getattr(hj, name)
        found += [(f"hj.{name}.{x}", thing) for x, thing in members(namespace).items()]
    return found


def parameters():
    """Each parameter of a public function or method, with its annotation."""
    for name, function in public():
        hints = getattr(function, "kinds", None)
        hints = {} if hints is None else hints.hints()
        for parameter in inspect.signature(function).parameters.values():
            if parameter.name not in ("self", "cls"):
                yield name, parameter, hints.get(parameter.name)


def parts(hint):
    """An annotation and all that it is made of."""
    yield hint
    for part in typing.get_args(hint):
        yield from parts(part)


def test_the_first_level_holds_what_a_first_day_needs():
    assert len(members(hj)) <= 36
    modules = {x for x in hj.__all__ if isinstance(getattr(hj, x), types.ModuleType)}
    assert modules == set(NAMESPACES)


def test_each_namespace_has_a_page():
    pages = {page.stem for page in (ROOT / "docs/reference").glob("*.md")}
    assert pages == {*NAMESPACES, "index", "session"}


def test_each_name_has_one_place():
    """Figures have the names of what they show."""
    places = [
        x.rpartition(".")[2] for x, _ in all_members() if not x.startswith("hj.plot.")
    ]
    repeated = [name for name, count in Counter(places).items() if count > 1]
    assert repeated == []


@pytest.mark.slow
def test_no_class_has_the_name_of_another():
    named = Counter()
    for file in (ROOT / "hybridjax").rglob("*.py"):
        for statement in ast.parse(file.read_text()).body:
            if isinstance(statement, ast.ClassDef):
                named[statement.name] += 1
    classes = {
        x.rpartition(".")[2] for x, thing in all_members() if isinstance(thing, type)
    }
    repeated = {name for name in classes if named[name] > 1}
    assert repeated == set()


def test_types_that_functions_return_can_be_imported():
    """Their pages are those of all public names (`test_site.py`)."""
    known = {thing for _, thing in all_members() if isinstance(thing, type)}
    for name, thing in all_members():
        if not inspect.isfunction(thing):
            continue
        for part in parts(typing.get_type_hints(thing).get("return")):
            own = isinstance(part, type) and part.__module__.startswith("hybridjax")
            assert not own or part in known, f"{name} returns {part}"


# Words of which each has another one, the same everywhere.
ONE_WORD = {
    "band": "frequencies",
    "confidence": "level",
    "definition": "sections",
    "doubt": "findings",
    "f": "frequencies",
    "freedom": "dof",
    "input_names": "inputs",
    "overhang": "extra_lags",
    "over": "values",
    "scatter": "variance_dof",
    "significance": "alpha",
    "want": "quantities",
    "wanted": "quantities",
    "warnings": "findings",
}


def test_one_thing_has_one_word():
    words = {(name, x.name) for name, x, _ in parameters()}
    for name, thing in all_members():
        if isinstance(thing, type):
            words |= {(name, x) for x in vars(thing) if not x.startswith("_")}
            words |= {(name, x) for x in getattr(thing, "__annotations__", {})}
    models = {(name, word) for name, word in words if name.startswith("hj.models.")}
    others = {(name, word) for name, word in words - models if word in ONE_WORD}
    assert others == set()


# Words that are no nouns, and say where or which.
WITHOUT_PLURAL = {"at_input", "at_output", "flipped", "free", "translation"}


def test_what_takes_several_names_is_plural():
    """It takes one, too."""
    for name, parameter, hint in parameters():
        several = any(isinstance(x, Names) for x in parts(hint))
        several = several or any(
            isinstance(x, Names) for part in parts(hint) for x in metadata(part)
        )
        if several and parameter.name not in WITHOUT_PLURAL:
            assert parameter.name.endswith("s"), f"{name}({parameter.name})"


def metadata(hint):
    return getattr(hint, "__metadata__", ())


def test_level_is_a_coverage_and_alpha_a_significance():
    found = set()
    for name, parameter, hint in parameters():
        if parameter.name in ("level", "alpha") and hint == Probability:
            found.add(parameter.name)
            is_coverage = (
                parameter.default is parameter.empty or parameter.default > 0.5
            )
            assert is_coverage == (parameter.name == "level"), name
    assert found == {"level", "alpha"}


@pytest.mark.parametrize(
    ("asked", "line"),
    [
        (lambda: hj.Settings, "hj.Settings is hj.orbits.Settings"),
        (lambda: hj.SeriesFit, "hj.SeriesFit is hj.identify.SeriesFit"),
        (lambda: hj.coincidences, "hj.coincidences is cycle.simultaneous_events()"),
        (lambda: hj.orbits.continuation, "hj.orbits.continuation is hj.continuation"),
        (lambda: hj.sections.linearize, "hj.sections.linearize is hj.linearize"),
        (lambda: hj.errors.simulate, "hj.errors.simulate is hj.simulate"),
        (
            lambda: hj.experiments.run_experiments,
            "hj.experiments.run_experiments is hj.run_experiments",
        ),
        (lambda: hj.plot.validation, "hj.plot.validation is validation.plot()"),
        (lambda: hj.plot.section_data, "hj.plot.section_data is data.plot()"),
        (lambda: hj.section_data, "hj.section_data is hj.recordings.sample_sections"),
        (lambda: hj.convert.to_pandas, "hj.convert.to_pandas is result.to_pandas()"),
        (lambda: hj.multisine(4, periods=4).f, "`f` of Design is `frequency`"),
        (
            lambda: hj.Crossing("x", "falling").function,
            "`function` of Crossing is `signal`",
        ),
    ],
)
def test_other_names_lead_to_those_now(asked, line):
    """Where they are, in one line; also after their modules were imported."""
    importlib.import_module("hybridjax.apps.reproduce")
    with pytest.raises(AttributeError) as raised:
        asked()
    assert str(raised.value) == line


def test_earlier_arguments_lead_to_those_now():
    with pytest.raises(TypeError, match="^`band` of multisine is `frequencies`$"):
        hj.multisine(4, periods=4, band=(0.0, 1.0))
    system = hj.linear.LDTP(
        np.full((1, 1, 1), 0.5), np.ones((1, 1, 1)), np.ones((1, 1, 1))
    )
    with pytest.raises(TypeError, match=r"^`f` of LDTP.htf is `frequencies`$"):
        system.htf(f=[0.1])


def test_the_table_of_earlier_names_leads_to_what_exists():
    places = {name for name, _ in all_members()}
    for name, now in tables._NAMES.items():
        assert tables.place_of(name) in (None, f"hj.plot.{name}")
        if now.startswith("hj."):
            assert now.partition("(")[0] in places, name
    functions = list(public())
    classes = {x.rpartition(".")[2]: thing for x, thing in all_members()}
    for key, now in tables._WORDS.items():
        owner, word = key.split(".")
        called = [f for name, f in functions if name.rpartition(".")[2] == owner]
        cls = classes.get(owner)
        words = set(dir(cls))
        for function in [*called, *([cls] if isinstance(cls, type) else [])]:
            words |= set(inspect.signature(function).parameters)
        assert word not in words, key
        assert set(now.split("` or `")) <= words, key


def test_namespaces_travel_to_other_processes():
    """Functions that use them are pickled with them, for processes and Dask's workers."""
    assert pickle.loads(cloudpickle.dumps(hj.plot)) is hj.plot
