"""Names that are slips in others."""

import difflib
from collections.abc import Collection


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
    """Return the name that another one is a slip of, in case or letters; None if none is."""
    # (The first of several counts.)
    in_lower_case = {other.lower(): other for other in reversed(list(among))}
    return in_lower_case.get(name.lower()) or spelled_alike(name, among)
