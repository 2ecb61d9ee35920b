"""Each public function says what it takes and returns, and the examples of the reference run."""

import inspect
import re
import sys
import types

import pytest

import hybridjax as hj
from hybridjax._core.showable import Showable

from .sessions import ROOT, fences
from .test_names import all_members


EXAMPLE = re.compile(
    r"^\*\*Example:\*\*\n\n```python\n(.*?)^```$", re.MULTILINE | re.DOTALL
)
# The functions before and after one: the last paragraph.
CHAIN = re.compile(r"^\*\*(?:Before|After):\*\*.*", re.MULTILINE | re.DOTALL)

# Examples that cannot run in the process of the tests, and why.
NOT_RUN = {
    "hj.explore": "it opens a window and waits for the user",
    "hj.scale.enable_loop_kernels": "XLA reads its options once, before JAX computes",
}


def text_of(thing):
    return inspect.cleandoc(thing.__doc__ or "")


THINGS = dict(all_members())
FUNCTIONS = {
    place: text_of(thing)
    for place, thing in THINGS.items()
    if inspect.isfunction(thing)
}
CLASSES = {
    place: text_of(thing) for place, thing in THINGS.items() if inspect.isclass(thing)
}
# What results have in common, documented once in their base classes. (A study of subjects hands on
# the methods of its population.)
COMMON = "plot", "to_pandas", "modulus", "interval", "compare", "contains"
METHODS = {
    f"{base.__qualname__}.{name}": text_of(vars(base)[name])
    for thing in THINGS.values()
    for base in getattr(thing, "__mro__", ())
    for name in COMMON
    if issubclass(thing, Showable) and name in vars(base)
    if base is not hj.recordings.SubjectStudy
}
TEXTS = FUNCTIONS | CLASSES | METHODS
EXAMPLES = {
    place: "\n".join(EXAMPLE.findall(text))
    for place, text in TEXTS.items()
    if EXAMPLE.search(text)
}


def test_public_functions_say_what_they_return():
    silent = {
        place
        for place, text in FUNCTIONS.items()
        if "**Returns:**" not in text and not text.startswith("Return ")
    }
    assert silent == set()


def test_public_functions_have_an_example():
    documented = FUNCTIONS | METHODS
    assert documented.keys() - EXAMPLES.keys() == set()


def test_public_functions_name_each_argument():
    missing = {
        f"{place}({name})"
        for place, text in FUNCTIONS.items()
        for name in inspect.signature(THINGS[place]).parameters
        if not re.search(rf"`\*{{0,2}}{name}`", text)
    }
    assert missing == set()


def test_places_in_the_chain_are_public_names():
    known = {*THINGS, *(f"hj.{name}" for name in hj.__all__)}
    for place, text in TEXTS.items():
        chain = "".join(CHAIN.findall(text))
        assert set(re.findall(r"`(hj\.[\w.]+)", chain)) <= known, place


@pytest.fixture(scope="module")
def objects():
    """Those that the page of the reference makes."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    made = {}
    page = (ROOT / "docs/reference/index.md").read_text()
    for language, code in fences(page):
        assert language == "python"
        exec(compile(code, "docs/reference/index.md", "exec"), made)
    return made


@pytest.mark.parametrize("place", sorted(EXAMPLES.keys() - NOT_RUN.keys()))
def test_examples_run(place, objects, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # (Classes with annotations in quotation marks look for their module.)
    module = types.ModuleType("example")
    monkeypatch.setitem(sys.modules, "example", module)
    vars(module).update(objects, __name__="example")
    exec(compile(EXAMPLES[place], place, "exec"), vars(module))
