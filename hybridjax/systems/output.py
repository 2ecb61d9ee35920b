"""Outputs z = h(t, q, u) of a hybrid system (paper eq. 4)."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import equinox as eqx

from .._core.boundary.checked import checked
from .._core.boundary.containers import Names
from .._core.executor import Definition
from .._core.text import fields


@checked
class Output(Definition):
    """A named scalar output z = h(t, q, u).

    **Fields:**

    - `name`: its name in data and plots.
    - `function`: one function (t, q, u) -> number for all charts, or a mapping from chart names to
        such functions. What a missing chart means is an error when the output is needed there.
    - `unit`: its unit, for figures and prints.
    """

    name: str = eqx.field(static=True)
    function: Callable[..., Any] | Mapping[str, Callable[..., Any]]
    unit: str = eqx.field(static=True, default="")

    def __repr__(self):
        return fields(self)


OutputNames = Annotated[Sequence[str | Output] | str | Output, Names(Output)]
"""States and outputs: one, or several distinct ones; names, or `Output`s in their place."""
