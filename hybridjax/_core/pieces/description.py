"""Descriptions of stored results: what was computed, as JSON with digests in place of functions. By
its description a later run recognizes results of the same job.

`store.py` compares descriptions; the callers of `run.py` write them.

Whatever changes numbers must be in a description, otherwise one store gets results of two jobs;
whatever does not (how many processes) must not. The mark of digests, `_DIGEST`, is written into
stores, and must stay.

If a store is refused without need, the message has the entry that `difference` found: look where
the job writes it. If a change is not noticed, look at `digest_of`, and at `meaning.py` behind it.
"""

import importlib.metadata
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ... import __version__
from ..meaning import meaning


def versions() -> dict[str, str]:
    """Return the versions of the packages on which numbers depend to the last bit."""
    names = ("jax", "jaxlib", "numpy", "scipy")
    return {"hybridjax": __version__} | {
        x: importlib.metadata.version(x) for x in names
    }


def difference(mine: Any, theirs: Any, name: str = "") -> str | None:
    """Return the first difference between two descriptions in words, None if they are the same."""
    if isinstance(mine, Mapping) and isinstance(theirs, Mapping):
        for key in dict.fromkeys([*theirs, *mine]):
            inside = ".".join(filter(None, [name, key]))
            if key not in mine:
                return f"`{inside}` is only there"
            if key not in theirs:
                return f"`{inside}` is not there"
            change = difference(mine[key], theirs[key], inside)
            if change is not None:
                return change
        return None
    if mine == theirs:
        return None
    if _is_digest(mine) or _is_digest(theirs):
        return f"its `{name}` is not the same"
    return f"its `{name}` is {_short(theirs)}, not {_short(mine)}"


def digest_of(*things: Any) -> str:
    """Return a digest of functions, definitions and values: see `meaning`. Arrays of JAX have the
    digests of NumPy's."""
    arrays = (np.asarray(x) if isinstance(x, jax.Array) else x for x in things)
    return marked(meaning(*arrays))


def marked(digest: str) -> str:
    """A digest in the form in which descriptions hold it, so that messages do not show it."""
    return _DIGEST + digest


_DIGEST = "digest:"


def _is_digest(x: Any) -> bool:
    return isinstance(x, str) and x.startswith(_DIGEST)


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 60 else text[:57] + "..."
