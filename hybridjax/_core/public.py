"""Public names: the module that each one is in, and the new names of those that were renamed.

The `__init__.pyi` of a namespace lists its public names. Each name is imported when it is first
used (PEP 562), and type checkers read the same list. The `__init__.py` of each namespace calls
`attach`.

A new public name is a line in the `__init__.pyi` of its namespace; a name that was renamed, a line
in the tables here. If a name is not found, look at `_homes`; if an error leads to the wrong name,
at `about_name`.
"""

import ast
import functools
import importlib
import pathlib
import sys
import types
from collections.abc import Callable
from typing import Any

from .exceptions import UnknownAttribute


_ROOT = pathlib.Path(__file__).parents[1]

# From names that were changed before version 0.2 to their present ones. (A namespace stands before
# names that are others elsewhere.)
_NAMES = {
    "Advice": "hj.recordings.Diagnosis",
    "BranchPoint": "hj.orbits.Bifurcation",
    "FrequencyResponse": "hj.designs.ResponseGoal",
    "Multipliers": "hj.designs.MultiplierGoal",
    "Options": "hj.run_experiments(..., start=, discard=, ...)",
    "Parameters": "hj.designs.ParameterGoal",
    "Points": "hj.scale.SweepPoints",
    "Quotient": "hj.systems.Symmetric",
    "Record": "hj.experiments.SectionSeries",
    "Scatter": "hj.linear.VarianceDof",
    "SettledCycle": "hj.plants.PlantCycle",
    "Study": "hj.designs.SequentialDesign",
    "add_command": "hj.recordings.attach_design",
    "advise": "hj.recordings.diagnose",
    "bodes": "hj.plot.bode",
    "choose_order": "hj.select_order",
    "coincidences": "cycle.simultaneous_events()",
    "draws": "hj.designs.draw_models",
    "forest": "population.plot(quantity)",
    "harmonics": "hj.plot.htf",
    "inspect": "hj.recordings.check_recording",
    "ldtp_bound": "hj.identify.cramer_rao(model, htf, estimator='fit_ldtp')",
    "loop": "hj.identify.estimate_loop",
    "magnitude": "hj.plot.htf",
    "multiplier_bound": "hj.identify.cramer_rao",
    "optimize_phases": "design.optimize_phases()",
    "plot.experiment": "data.plot(index)",
    "plot.impulse_responses": "responses.plot()",
    "plot.phase": "phase.plot()",
    "plot.save": "plot.save(path), a method of every figure",
    "plot.section_data": "data.plot()",
    "plot.sweep": "maps[quantity].plot(), of what `hj.sweep` returns",
    "plot.validation": "validation.plot()",
    "random_force": "hj.experiments.random_input",
    "section_data": "hj.recordings.sample_sections",
    "settle": "hj.plants.find_cycle",
    "simultaneous_events": "cycle.simultaneous_events()",
    "sliding": "hj.systems.filippov",
    "spoil": "hj.testing.add_artifacts",
    "stream_experiments": "hj.run_experiments(..., chunk=, store=)",
    "strides": "hj.plot.standard_errors",
    "subject_maps": "maps.plot(), of the mean or difference of maps",
    "to_pandas": "result.to_pandas()",
    "write_design": "design.write(path)",
    "write_report": "result.write_report(folder)",
}
# From former names of arguments and attributes to the present ones.
_WORDS = {
    "Branch.points": "bifurcations",
    "Crossing.function": "signal",
    "Design.f": "frequency",
    "Design.input_names": "inputs",
    "Diagnosis.band": "bandwidths",
    "Diagnosis.strides": "cycles",
    "Diagnosis.warnings": "findings",
    "HTF.f": "frequencies",
    "HTF.scatter": "variance_dof",
    "Identification.advice": "diagnosis",
    "LDTP.stable": "is_stable",
    "LimitCycle.stable": "is_stable",
    "Limits.strides": "cycles",
    "MultiplierGoal.overhang": "extra_lags",
    "OptimalDesign.strides": "cycles",
    "OptimalDesign.strides_for": "cycles_for",
    "ParameterGoal.wanted": "quantities",
    "PhaseResponse.freedom": "dof",
    "Population.freedom": "dof",
    "ResponseGoal.band": "frequencies",
    "ResponseGoal.wanted": "quantities",
    "SequentialDesign.strides": "cycles",
    "SeriesFit.reference": "references",
    "Validation.level": "alpha",
    "VarianceDof.freedom": "dof",
    "asymptotic_phase.turns": "cycles",
    "continuation.values": "range",
    "estimate_htf.reference": "references",
    "estimate_phase.definition": "sections",
    "fit_ldtp.guess": "dims` or `initial",
    "fit_ldtp.reference": "references",
    "fit_multipliers.errors": "covariance",
    "fit_multipliers.overhang": "extra_lags",
    "fit_series.overhang": "extra_lags",
    "fit_series.reference": "references",
    "htf.f": "frequencies",
    "identify_recording.phase": "sections",
    "identify_recording.reference": "references",
    "multisine.band": "frequencies",
    "noise_spectrum.f": "frequencies",
    "phase_response.phase": "sections",
    "sample_sections.phase": "sections",
    "select_order.htf": "data",
    "select_order.overhang": "extra_lags",
    "sweep.over": "values",
    "sweep.want": "quantities",
    "validate.level": "alpha",
    "validate.reference": "references",
}


class Namespace(types.ModuleType):
    """A module that says what to call, if it is called itself."""

    def __reduce__(self) -> Any:
        # (Pickles of functions that use a module know plain modules only.)
        return importlib.import_module, (self.__name__,)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError(_leads().about_called(self.__name__))


def _leads() -> Any:
    """Return the module with the tables of errors. (It imports this one.)"""
    return importlib.import_module(".boundary.leads", __package__)


def attach(package: str, file: str) -> tuple[Callable, Callable, list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package whose public names are listed in its
    `__init__.pyi`."""
    homes = _homes(pathlib.Path(file).with_suffix(".pyi"))
    names = sorted(homes)
    sys.modules[package].__class__ = Namespace

    def __getattr__(name: str) -> Any:
        home = homes.get(name)
        if home is None:
            about = functools.partial(about_name, package, name, names)
            raise UnknownAttribute(about)
        module = importlib.import_module(home, package)
        is_namespace = home == f".{name}"
        return module if is_namespace else getattr(module, name)

    def __dir__() -> list[str]:
        return names

    return __getattr__, __dir__, names


def about_name(package: str, name: str, names: list[str]) -> str:
    """Return one line that leads from a name that a namespace does not have to the one that is
    meant."""
    asked = package.replace("hybridjax", "hj", 1) + f".{name}"
    namespace = asked.removeprefix("hj.").rpartition(".")[0]
    now = _NAMES.get(f"{namespace}.{name}", _NAMES.get(name))
    if now is not None:
        return f"{asked} is {now}"
    place = place_of(name)
    if place is not None:
        other = _leads().other_than(package, name)
        if other is not None:
            rest = "" if place in other else f"; another function is {place}"
            return f"there is no {asked}: {other}{rest}"
        return f"{asked} is {place}"
    own_place = package.replace("hybridjax", "hj", 1)
    known = {own: f"{own_place}.{own}" for own in names} | places()
    return f"there is no {asked}: {_leads().about_name(package, name, known)}"


def place_of(name: str) -> str | None:
    """Return the place of a public name, such as `hj.plot.bode`; None if there is none."""
    return places().get(name)


def is_namespace(name: str) -> bool:
    """Test whether a public name is a module of functions, such as `plot`."""
    return (_ROOT / name / "__init__.pyi").exists()


@functools.cache
def places() -> dict[str, str]:
    """The place of each public name: the package's before those of its namespaces, and names of
    figures last."""
    stubs = [_ROOT / "__init__.pyi", *sorted(_ROOT.glob("*/__init__.pyi"))]
    stubs.sort(key=lambda stub: stub.parent.name == "plot")
    found: dict[str, str] = {}
    for stub in stubs:
        namespace = ".".join(["hj", *stub.parent.relative_to(_ROOT).parts])
        for name in _homes(stub):
            found.setdefault(name, f"{namespace}.{name}")
    return found


def about_word(owner: str, word: str) -> str | None:
    """Return one line about an earlier argument of a function, or attribute of a class."""
    word_now = _WORDS.get(f"{owner.rpartition('.')[2]}.{word}")
    return word_now and f"`{word}` of {owner} is `{word_now}`"


def _homes(stub: pathlib.Path) -> dict[str, str]:
    """The modules of the names in a stub, relative to its package."""
    homes = {}
    for statement in ast.parse(stub.read_text(encoding="utf-8")).body:
        if not isinstance(statement, ast.ImportFrom):
            continue
        package = "." * statement.level
        for alias in statement.names:
            homes[alias.name] = package + (statement.module or alias.name)
    return homes
