"""Outputs z = h(t, q, u) of a hybrid system (paper eq. 4)."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx

from .._core.executor import Definition


class Output(Definition):
    """A named scalar output z = h(t, q, u).

    **Fields:**

    - `name`: its name in data and plots.
    - `function`: one function (t, q, u) -> number for all charts, or a mapping from chart names to
        such functions. What a missing chart means is an error when the output is needed there.
    """

    name: str = eqx.field(static=True)
    function: Callable[..., Any] | Mapping[str, Callable[..., Any]]
