"""Base classes of results: `Showable`, with `plot`, `to_pandas` and `findings`, and
`WithMultipliers`, for results that have Floquet multipliers.

A new type of result gets a function in `convert/tables.py`, a figure in `plot/first.py` or
`plot/first_of_data.py`, and a line in the list of `to_pandas` here. If a table or a figure is
wrong, look at its function in those files.

If attributes or methods of a result misbehave, look at `boundary/members.py`, whose functions are
put into the classes here: an attribute that does not exist raises an error that leads on
(`missing_attribute`), results cannot be changed (`fixed_attribute`), and a public method prints how
to call it (`bind_methods`).
"""

import importlib
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import Float

from .boundary.members import bind_methods, fixed_attribute, missing_attribute
from .findings import Finding


class Showable:
    """A result that can be drawn and put in a table, and that lists the reasons to doubt it.

    **Fields:** `findings`, reasons to doubt the result; empty where there are none, or where the
    step that made it does not look for any.
    """

    _stands_for: ClassVar[tuple[str, ...]] = ()
    """Fields that functions use if they are given this result. With ("fit", "data"), a function
    that needs a fit takes the result and uses its `fit` (`boundary/containers.py`)."""

    if TYPE_CHECKING:
        # (A field of some results, and a property of others: neither can be declared for all. For
        # the same reason, checkers of types do not see the default.)
        @property
        def findings(self) -> tuple[Finding, ...]: ...
    else:
        findings = ()
        __getattr__ = missing_attribute
        __setattr__ = fixed_attribute

        def __init_subclass__(cls, **options: Any):
            super().__init_subclass__(**options)
            bind_methods(cls)

    def plot(self, *args: Any, **options: Any) -> Any:
        """Draw what one would ask for first.

        **Arguments:** those of the function of `hj.plot` that draws it, such as `ax`.

        **Returns:** a `Plot`, with `save(path)`, `show()` and `axes`.

        **Raises:** `DefinitionError` for a result that has no figure.

        **Example:**

        ```python
        cycle.plot("yM", "vM").show()
        htf.plot(outputs="yM").save("htf.pdf")
        ```
        """
        # (Imported by name, as figures import the results.)
        first = importlib.import_module("hybridjax.plot.first")
        return first.draw(self, *args, **options)

    def to_pandas(self) -> Any:
        """Return a table of the result.

        - Fits: a row for each multiplier, with the 95 % interval of its modulus. Fits of
          parameters: a row for each parameter. A `RationalFit` gives a row for each output and
          pole.
        - `LimitCycle`, `LimitCycles`, `Branch`: a row for each cycle, with its parameters;
          `multipliers.0.real`, ...
        - `HTF`: a row for each harmonic, frequency, output and input, which are the index.
        - `LDTP`: a row for each multiplier.
        - `Recording`, `SectionData`: a row for each sample, with time and trial;
          `Recording.from_frame` reads one trial of it. `ExperimentData`, `SectionSeries`: likewise,
          with the number of the experiment, the cycle and the section.
        - `Design`: a row for each cosine. `Trajectory`, `Flow`: a row for each end of a step.
        - `OrderSelection`, `Validation`, `OptimalDesign` and comparisons: the table that they
          print.
        - `PhaseCurve`, `ImpulseResponses`: a row for each value. `Sensitivity`: a row for each
          event. `Identifiability`: a row for each parameter. `PlantCycle`: a row for each section.
          `Population`: its `table`.
        - Other results that have findings: a row for each.

        Complex numbers get columns for their real and imaginary part, which R and CSV files can
        hold; H and multipliers their modulus, too. `standard_error` is the root of the expected
        squared distance from the true value; `real_error` and `imaginary_error` are those of the
        parts.

        **Returns:** a `pandas.DataFrame`.

        **Raises:** `DefinitionError` where pandas, or xarray, is not installed, and for a result
        that is no table.

        **Example:**

        ```python
        fit.to_pandas().to_csv("fit.csv")
        print(data.to_pandas().head())
        ```
        """
        # (Imported by name, as tables import the results.)
        tables = importlib.import_module("hybridjax.convert.tables")
        return tables.to_pandas(self)


# (`__init_subclass__` is called for the classes that inherit, and not for `Showable` itself.)
bind_methods(Showable)


class WithMultipliers(Showable):
    """A result that has Floquet multipliers."""

    if TYPE_CHECKING:
        # (A field of some results, and a property of others, as `findings`.)
        @property
        def multipliers(self) -> Any: ...

    @property
    def modulus(self) -> Float[np.ndarray, "*n"]:
        """The moduli of the multipliers: the parts of deviations that are left after a period.

        **Example:**

        ```python
        print(cycle.modulus.max())
        print(f"{fit.modulus[0]:.1%} of a deviation is left after a cycle")
        ```
        """
        return np.abs(self.multipliers)
