"""Type checkers see what users see: no false errors in the tour's sessions, and public signatures
that say what they take."""

import importlib
import inspect
import json
import os
import re
import sys
import typing

import pytest

from .sessions import ROOT, run_python


BLOCK = re.compile(r"^```(?:python|py)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

# What the tour leaves out, and users write.
MORE = """
hj.models.VerticalHopper(k=11.0)
hj.find_limit_cycle(Juggler(g=9.8), hj.Guess("flight", (0.2, 4.5), time=0.1))
hj.ClockPhase(8, anchor=0.05)
hj.linearize(cycle, [hj.AtEvent("touchdown"), apex]).multipliers
hj.sections.section_map(cycle, phase, 0, 0)(cycle.anchor.q[:4, 0])
series = hj.experiments.SectionSeries(data.u[0], data.y[0], n_sections=32)
hj.fit_series([data, series], order=2).multipliers
hj.plot.cycle(cycle, sections=hj.sections.place_sections(cycle, phase)).ax.set_title("hopper")
recording.trials[0].values.shape
hj.Guess("flight", jnp.array([0.2, 4.5]), 0)
hj.KinematicPhase(8, "yM", "vM", (1.9, 0.0), [0.3, 1.9], anchor=0.5)
hj.Crossing("vM", "falling", 0.1, charts=("flight",))
hj.orbits.Settings(rtol=1e-8, atol=1e-9, max_steps=100)
hj.systems.Scheduled(0.5, offset=0.1)
hj.models.VerticalHopper(k=jnp.array(11.0)).k + 1.0
largest: complex = complex(cycle.multipliers[0])
print(abs(cycle.multipliers).max(), branch.multipliers.shape, float(cycle.period) + 1)
hj.linear.LDTP([[[0.5]]], [[[1.0]]], [[[1.0]]]).htf([0.1, 0.2])
hj.experiments.SectionSeries([[1.0], [2.0]], [[1.0], [2.0]], n_sections=2)
hj.simulate(hopper, "flight", (2.0, 1.0, 0.0, 0.0), cycle.period)
hj.convert.to_lti(model).multipliers.shape
hj.optimal_design(model, limit={"u": 0.01}, goal=hj.designs.MultiplierGoal(0, "modulus")).advice
hj.optimal_design([model], limit=hj.designs.Limits(peak={"u": 0.1})).advice
hj.optimal_design(model, noise={"yM": 1e-4}, goal=hj.designs.ResponseGoal((0.1, 1.0))).saved
hj.designs.Limits(distortion=hj.designs.Distortion(cycle, phase, {"yM": 1e-5})).distortion
hj.read_recording("walk.c3d", signals=("LASI.x", "Fz1")).signals
hj.Recording.beside([recording, recording]).units
hj.identify_recording("walk.csv", apex, "u", "yM")
hj.identify_recording({"time": [0.0, 1.0], "y": [0.0, 1.0]}, "strike", "u", "y")
hj.Recording({"time": [0.0, 1.0], "y": [0.0, 1.0]}).signals
hj.find_limit_cycle(hopper, (2.0, 1.0, 0.0, 0.0), section="touchdown")
hj.simulate(hopper, {"yM": 2.0, "vM": 1.0, "ym": 0.0, "vm": 0.0}, 1.0)
hj.simulate(hopper, duration=1.0)
hj.find_limit_cycle(lambda t, q: (q[1], -q[0]), (2.0, 0.0)).multipliers
float(hj.flow(hopper, [2.0, 1.0, 0.0, 0.0], 1.0)["yM"])
hj.sweep(hopper, k=[9.0, 10.0], b=5.0)
hj.continuation(cycle, k=(9.0, 11.0)).stable
hj.continuation(cycle, k=(9.0, 11.0)).bifurcations[0].kind
model.htf([0.1])["yM"].select(0, outputs="yM", inputs="u").magnitude.shape
model.htf([0.1])[0].shape
hj.plot.bode(hj.fit_series(data, order=2))
hj.plot.bode({"both": [model, hj.fit_series(data, order=2)]})
recording.crop(0.0, stop=10.0).duration
hj.linearize(cycle, ["touchdown", apex])
hj.fitting.ObservedCycle(phase, "yM", jnp.zeros((32, 1)), period=1.0, std=0.1)
"""


@pytest.fixture(scope="module")
def script():
    """The tour's sessions as one script."""
    tour = (ROOT / "docs/how-to/tour.md").read_text()
    return "\n\n".join(BLOCK.findall(tour)) + MORE


@pytest.mark.slow
def test_a_users_script_has_no_errors_in_mypy(tmp_path, script):
    (tmp_path / "session.py").write_text(script)
    options = ["--follow-imports=silent", "--cache-dir=cache"]
    paths = {"MYPYPATH": str(ROOT)}
    run_python(
        "-m", "mypy", *options, "session.py", cwd=tmp_path, env={**os.environ, **paths}
    )


def test_a_users_script_has_no_errors_in_pyright(tmp_path, script):
    """In its basic mode."""
    (tmp_path / "session.py").write_text(script)
    about = {
        "typeCheckingMode": "basic",
        "include": ["session.py"],
        "extraPaths": [str(ROOT)],
    }
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(about))
    run_python("-m", "basedpyright", "-p", tmp_path, "--pythonpath", sys.executable)


@pytest.mark.slow
@pytest.mark.parametrize(
    "checker",
    [("mypy",), ("basedpyright", "--pythonpath", sys.executable)],
    ids=lambda c: c[0],
)
def test_the_package_has_no_type_errors(checker):
    """With the settings in pyproject.toml."""
    run_python("-m", *checker, cwd=ROOT)


# Arguments that may be anything: what a subclass declares, what users' functions return, objects of
# a library that is an extra, and what the function looks at by itself.
ALLOWED = {
    "Chart.field",
    "HybridSystem.period",
    "HybridSystem.replace",
    "sweep.maps",
    "save.thing",
    "Recording.__init__.time",
    "Recording.from_frame.frame",
    "from_xarray.dataset",
    "MuJoCoPlant.__init__.model",
    "MuJoCoPlant.set_state",
    "PlantCycle.__init__.state",
    "SubjectStudy.__init__.results",
    "identify_subjects.options",
}


def public():
    """Public functions, and the methods of public classes and their constructors, by name."""
    folders = [
        ROOT / "hybridjax",
        *(f.parent for f in (ROOT / "hybridjax").glob("*/__init__.pyi")),
    ]
    for folder in folders:
        module = importlib.import_module(".".join(folder.relative_to(ROOT).parts))
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing):
                yield name, thing
            elif inspect.isclass(thing) and thing.__module__.startswith("hybridjax"):
                for part, method in vars(thing).items():
                    method = getattr(method, "__func__", method)
                    own = (
                        inspect.isfunction(method)
                        and method.__qualname__ == f"{name}.{part}"
                    )
                    # (`HybridSystem.__new__` checks models; their methods are functions of states.)
                    own = own and not thing.__module__.startswith("hybridjax.models")
                    if own and (part[0] != "_" or part in SPECIAL):
                        yield f"{name}.{part}", method


SPECIAL = ("__call__", "__getitem__", "__init__")


def test_public_signatures_say_what_they_take():
    for name, function in public():
        for parameter in inspect.signature(function).parameters.values():
            allowed = {name, f"{name}.{parameter.name}"} & ALLOWED
            if parameter.name not in ("self", "cls") and not allowed:
                vague = parameter.annotation in (
                    inspect.Parameter.empty,
                    typing.Any,
                    "Any",
                )
                assert not vague, f"{name}({parameter.name})"


# What is not checked where it is called, each for a reason. (Of results only the methods are
# checked: this package makes them, and JAX does, with leaves of any kind.)
UNCHECKED = {
    "written by users, called by the engine": {
        "Chart.field",
        "HybridSystem.draw",
        "AbstractSections.bind",
        "AbstractSections.check",
        "AbstractSections.describe",
        "AbstractLevels.level",
        "AbstractLevels.present",
        "AbstractObservation.prepare",
        "AbstractObservation.residuals",
        "Plant.reset",
        "Plant.step",
        "Plant",
    },
    "checked with the system, by what takes it": {"HybridSystem"},
    "checked by the constructor of the system": {"HybridSystem.replace"},
    "checked by its own constructor, inside of `draw`": {"Drawing", "Drawing.spring"},
    "called by this package": {
        "Diagnosis.with_earlier",
        "LDTPFit.spread",
        "Phase.by_trial",
        "Phase.samples",
        "SeriesFit.predicted",
        "SeriesFit.spread",
    },
    "made by this package": {
        "Arrival",
        "Bifurcation",
        "Branch",
        "BranchEnd",
        "Constrained",
        "Coupling",
        "Diagnosis",
        "Event",
        "Explorer",
        "FilippovParts",
        "Finding",
        "Flow",
        "Fluctuations",
        "HarmonicStateSpace",
        "HeldOut",
        "HeldOutOrders",
        "Identifiability",
        "Identification",
        "Impact",
        "Impulse",
        "ImpulseResponses",
        "Inspection",
        "IntervalForecast",
        "LDTPFit",
        "LimitCycle",
        "LimitCycles",
        "Locked",
        "Loop",
        "MapResult",
        "ModelFit",
        "ModelIdentification",
        "Motion",
        "MultiplierComparison",
        "MultiplierEstimate",
        "NaturalIdentification",
        "NaturalMultipliers",
        "OptimalDesign",
        "OrderSelection",
        "ParameterComparison",
        "ParameterEstimate",
        "ParameterGuess",
        "Phase",
        "PhaseCurve",
        "PhaseResponse",
        "PlacedSections",
        "PlantCycle",
        "Plot",
        "RationalFit",
        "Response",
        "ResponseFunction",
        "Responses",
        "Returns",
        "SectionData",
        "SectionMap",
        "Sensitivity",
        "SeriesFit",
        "SimultaneousEvents",
        "StructuredFit",
        "SubjectStudy",
        "Trajectory",
        "TransientFit",
        "Trial",
        "Validation",
    },
}


def test_public_functions_check_what_they_are_given():
    unchecked = set().union(*UNCHECKED.values())
    for name, function in public():
        if not any(p != "self" for p in inspect.signature(function).parameters):
            continue
        if name.removesuffix(".__init__") in unchecked:
            assert not hasattr(function, "kinds"), (
                f"{name} is checked: take it off the list"
            )
        else:
            assert function.kinds.by_name, f"{name} is not checked"
