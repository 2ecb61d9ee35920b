"""Each public function says what it takes and returns, and the examples of the reference run."""

import inspect
import re

import pytest

import hybridjax as hj
from hybridjax._core.public import places

from .sessions import ROOT, fences


EXAMPLE = re.compile(
    r"^\*\*Example:\*\*\n\n```python\n(.*?)^```$", re.MULTILINE | re.DOTALL
)

# Examples that cannot run in the process of the tests, and why.
NOT_RUN = {
    "hj.explore": "it opens a window and waits for the user",
    "hj.scale.enable_loop_kernels": "XLA reads its options once, before JAX computes",
}


def text_of(place):
    """The docstring of a public function or class; None for modules and constants."""
    thing = hj
    for name in place.split(".")[1:]:
        thing = getattr(thing, name)
    is_function = inspect.isfunction(thing)
    if not is_function and not inspect.isclass(thing):
        return None, is_function
    own = thing.__doc__ or ""
    return inspect.cleandoc(own), is_function


TEXTS = {place: text_of(place) for place in places().values()}
FUNCTIONS = {place: text for place, (text, is_function) in TEXTS.items() if is_function}
EXAMPLES = {
    place: "\n".join(EXAMPLE.findall(text))
    for place, (text, _) in TEXTS.items()
    if text and EXAMPLE.search(text)
}


def test_public_functions_say_what_they_return():
    silent = {
        place
        for place, text in FUNCTIONS.items()
        if "**Returns:**" not in text and not text.startswith("Return ")
    }
    assert silent == set()


def test_public_functions_have_an_example():
    assert FUNCTIONS.keys() - EXAMPLES.keys() == set()


def test_public_functions_name_each_argument():
    def arguments(place):
        function = hj
        for name in place.split(".")[1:]:
            function = getattr(function, name)
        return inspect.signature(function).parameters

    missing = {
        f"{place}({name})"
        for place, text in FUNCTIONS.items()
        for name in arguments(place)
        if not re.search(rf"`\*{{0,2}}{name}`", text)
    }
    assert missing == set()


def test_places_in_the_chain_are_public_names():
    """Namespaces count, and what is reached through a class."""
    known = {*places().values(), *(f"hj.{name}" for name in hj.__all__)}
    for place, (text, _) in TEXTS.items():
        for line in re.findall(
            r"^\*\*(?:Before|After):\*\*.*", text or "", re.MULTILINE | re.DOTALL
        ):
            named = re.findall(r"`(hj\.[\w.]+)", line)
            assert set(named) <= known, place


@pytest.fixture(scope="module")
def objects():
    """Those that the page of the reference makes."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    made = {"__name__": "examples"}
    page = (ROOT / "docs/reference/index.md").read_text()
    for language, code in fences(page):
        assert language == "python"
        exec(compile(code, "docs/reference/index.md", "exec"), made)
    return made


@pytest.mark.parametrize("place", sorted(EXAMPLES.keys() - NOT_RUN.keys()))
def test_examples_run(place, objects, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[place], place, "exec"), dict(objects))
