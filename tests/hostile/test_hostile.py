"""Hostile calls: each returns, or is refused at once by a sentence that names what is wrong."""

import inspect
import json

import pytest

from ..sessions import ROOT, run_python
from ..test_typing import UNCHECKED, public


# Public names that the table leaves out, each for a reason.
CALLED_BY_THE_ENGINE = {
    "AbstractLevels",
    "AbstractObservation",
    "AbstractSections",
    "ArcLength",
    "AtEvent",
    "BoundSections",
    "BuckConverter",
    "Chart",
    "ClockPhase",
    "CompliantHopper",
    "Crossing",
    "Drawing",
    "FMUPlant",
    "GymnasiumPlant",
    "HybridSystem",
    "KinematicPhase",
    "Lanes",
    "Mechanism",
    "Motion",
    "MuJoCoPlant",
    "ObservedSeries",
    "ObservedTrajectory",
    "PaddleJuggler",
    "PlacedSections",
    "Plan",
    "Plant",
    "SweepPoints",
    "ProcessNoise",
    "Symmetric",
    "SLIPRunner",
    "Scheduled",
    "SectionList",
    "Settings",
    "TwoLeggedBar",
    "VerticalHopper",
}
SLOW_TO_MAKE = {"ModelFit", "StoredExperiments", "SubjectStudy"}
# Results of methods of results, whose tests call them.
FURTHER_RESULTS = {
    "Coupling",
    "Explorer",
    "Flow",
    "Fluctuations",
    "Responses",
    "Trajectory",
}


def printed(*command):
    """By a process without this one's check of types."""
    return json.loads(run_python("-m", *command, timeout=1800, cwd=ROOT))


@pytest.fixture(scope="module")
def outcome():
    """What is wrong with the calls, by function."""
    return printed("tests.hostile.run")


def test_hostile_calls_are_refused_in_one_sentence(outcome):
    wrong_calls = {name: wrong for name, wrong in outcome["calls"].items() if wrong}
    assert not wrong_calls


def test_hostile_calls_write_nothing(outcome):
    assert outcome["files"] == []


def test_all_public_names_are_called(outcome):
    """All functions, and all methods but constructors of what only this package makes."""
    missing = []
    for name, function in public():
        owner, _, method = name.partition(".")
        takes = set(inspect.signature(function).parameters) - {"self", "cls"}
        left_out = CALLED_BY_THE_ENGINE | SLOW_TO_MAKE | FURTHER_RESULTS
        if not takes or method == "__init__" or owner in left_out:
            continue
        if name in UNCHECKED["called by this package"]:
            continue
        called = name.removesuffix(".__call__")
        if owner == "Fit":  # (The base class has no objects of its own.)
            called = f"SeriesFit.{method}"
        if called not in outcome["calls"]:
            missing.append(name)
    assert not missing, missing


@pytest.mark.slow
def test_all_hostile_values_are_refused_in_one_sentence():
    calls = printed("tests.hostile.run", "--all")["calls"]
    assert not {name: wrong for name, wrong in calls.items() if wrong}
