"""Names that users misspell: which known name was meant.

`arguments.py` (names of states, outputs and inputs) and `boundary/leads.py` (names of functions,
attributes and arguments) call these functions before they raise an error.
"""

import difflib
from collections.abc import Collection, Iterable


# Likeness of two spellings, from 0 to 1, at which one is taken for a slip in the other. Lower:
# names of other things are suggested. Higher: slips lead nowhere.
_SLIP = 0.85


def spelled_alike(
    name: str, among: Collection[str], likeness: float = _SLIP
) -> str | None:
    """Return the name that is spelled most alike; None if none is alike."""
    alike = difflib.get_close_matches(name, among, n=1, cutoff=likeness)
    return alike[0] if alike else None


def slip_of(name: str, among: Collection[str]) -> str | None:
    """Return the name for which another one is a slip: the same word written otherwise, or a name
    that is spelled alike; None if there is none."""
    return same_word(name, among) or spelled_alike(name, among)


def same_word(name: str, among: Iterable[str]) -> str | None:
    """Return the first name that differs only in case, underscores and plural; None if there is
    none."""
    by_word = {plain(other).lower(): other for other in reversed(list(among))}
    return by_word.get(plain(name).lower())


def plain(word: str) -> str:
    """Return a word without case, underscores and plural. (Single letters differ by case.)"""
    without = word.replace("_", "")
    if len(without) < 2:
        return without
    without = without.lower()
    is_plural = (
        len(without) > 3 and without.endswith("s") and not without.endswith("ss")
    )
    return without[:-1] if is_plural else without
