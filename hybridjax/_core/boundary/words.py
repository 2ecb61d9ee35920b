"""Looking up the words of other libraries in the tables of `guesses`.

`leads.py` calls it, only where an error is raised: that must stay so, since tables are searched and
other libraries imported. Words are compared by `plain` (`spelling.py`), without case, underscores
and plural. An owner is the class, function or namespace to which the words of a table belong; ""
owns those for all functions, or for the package.

If a word leads to the wrong sentence, look at the order of `owners` in the call of `lead_of`: the
first that has the word wins. If the words in a longer name are not found, look at `parts`, which
leaves out words of one or two letters but those in `_SHORT`; if a word of this package is missing,
at `WORDS` and `ALIKE` in `guesses/synonyms.py`.
"""

import functools
import importlib
import re
from collections.abc import Iterable, Iterator

from ..spelling import plain
from .guesses.sentences import LIBRARIES
from .guesses.synonyms import ALIKE, WORDS


# Words of two letters that stand for one thing in names such as `multipliers_ci`.
_SHORT = {"ci", "se", "sd"}


def lead_of_library(owners: Iterable[str], name: str) -> str | None:
    """Return the sentence of the first library that has a name. (Libraries that are installed are
    imported for that: an error has time.)"""
    for owner in owners:
        for path, sentence in LIBRARIES.get(owner, {}).items():
            if _has(path, name):
                return sentence
    return None


def _has(path: str, name: str) -> bool:
    """Test whether a module, or a class in it, has a name."""
    module, _, cls = path.rpartition(".")
    is_class = cls[:1].isupper()
    try:
        thing = importlib.import_module(module if is_class else path)
    except ImportError:
        return False
    return hasattr(getattr(thing, cls) if is_class else thing, name)


def lead_of(table: dict, owners: Iterable[str], name: str) -> str | None:
    """Return the sentence of the whole name, of the first owner that has it."""
    word = plain(name)
    for owner in owners:
        sentence = _by_word(table, owner).get(word)
        if sentence is not None:
            return sentence
    return None


def synonyms(name: str) -> tuple[str, ...]:
    """Return the words of this package for a word of other libraries, the best one first."""
    return _all_words().get(name) or _plain_words().get(plain(name), ())


def parts(name: str) -> Iterator[str]:
    """Iterate over the words in a name, the last one first. (Letters stand for too much.)"""
    found = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+(?:\d+[a-z]+)*", name)
    for part in reversed(found):
        is_word = len(part) > 2 or part in _SHORT
        if is_word and len(found) > 1:
            yield part.lower()


def with_part(part: str, among: Iterable[str]) -> str | None:
    """Return the first name that contains this word, or another word for the same thing."""
    by_part: dict[str, str] = {}
    for name in among:
        for word in (name, *parts(name)):
            by_part.setdefault(plain(word), name)
    for word in (part, *synonyms(part)):
        if len(word) > 2 and plain(word) in by_part:
            return by_part[plain(word)]
    return None


@functools.cache
def _all_words() -> dict[str, tuple[str, ...]]:
    found = dict(WORDS)
    for word, others in ALIKE.items():
        for other in others.split():
            found.setdefault(other, WORDS.get(word, (word,)))
    return found


@functools.cache
def _plain_words() -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for word, meant in _all_words().items():
        found.setdefault(plain(word), meant)
    return found


def _by_word(table: dict[str, dict[str, str]], owner: str) -> dict[str, str]:
    """The sentences of an owner by their words. (Only where an error is raised.)"""
    found: dict[str, str] = {}
    for owners, sentences in table.items():
        if owner not in (owners.split() or [""]):
            continue
        for sentence, words in sentences.items():
            for word in words.split():
                found.setdefault(plain(word), sentence)
    return found
