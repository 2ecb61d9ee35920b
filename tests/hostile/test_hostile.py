"""Hostile calls: each is refused at once, in a sentence that names what is wrong."""

import inspect
import json
import pathlib
import subprocess
import sys

import pytest

from ..test_typing import public


# Public names that the table leaves out, each for a reason.
CALLED_BY_THE_ENGINE = {
    "AbstractLevels", "AbstractObservation", "AbstractSections", "ArcLength", "AtEvent",
    "BoundSections",
    "BuckConverter", "Chart", "ClockPhase", "CompliantHopper", "Crossing", "KinematicPhase",
    "Lanes", "Mechanism", "ObservedSeries", "PaddleJuggler", "PlacedSections", "Plan", "Points",
    "ProcessNoise", "ReturnMap", "SLIPRunner", "Scheduled", "SectionList", "Settings", "Structure",
    "TwoLeggedBar", "VerticalHopper", "Winding",
}  # fmt: skip
SLOW_TO_MAKE = {"EventTimes", "ModelFit", "StoredExperiments"}


def printed(*command):
    """By a process without this one's check of types."""
    run = subprocess.run(
        [sys.executable, "-m", *command],
        capture_output=True, text=True, timeout=1800, cwd=pathlib.Path(__file__).parents[2],
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.fixture(scope="module")
def outcome():
    """What came of every call."""
    return printed("tests.hostile.run")


def test_hostile_calls_are_refused(outcome):
    wrong = [f"{call}: {what}" for call, what in outcome["calls"].items() if what]
    assert not wrong, "\n".join(wrong)


def test_hostile_calls_write_nothing(outcome):
    assert outcome["files"] == []


def test_all_public_names_are_called(outcome):
    """All functions, and all methods but constructors of what only this package makes."""
    called = {call.partition("(")[0].removeprefix("plot.") for call in outcome["calls"]}
    missing = []
    for name, function in (each.values for each in public()):
        owner, _, method = name.partition(".")
        takes = set(inspect.signature(function).parameters) - {"self", "cls"}
        if not takes or method == "__init__" or owner in CALLED_BY_THE_ENGINE | SLOW_TO_MAKE:
            continue
        if name.removesuffix(".__call__") not in called:
            missing.append(name)
    assert not missing


def test_random_arguments_are_taken_or_refused():
    names = "HTF", "LDTP", "Record", "Design.from_lines", "impulse_responses", "estimate_htf"
    assert printed("tests.hostile.fuzz", "--examples", "20", *names) == {}


@pytest.mark.slow
def test_many_random_arguments_are_taken_or_refused():
    assert printed("tests.hostile.fuzz", "--examples", "100") == {}
