"""Random hybrid systems: hybridjax and an event loop over scipy see the same events."""

import numpy as np
import pytest

from . import scipy_loop
from .campaign import check, shares
from .drawing import arrow, still
from .structures import Arrow, Plan, Sample, Start


def agree(jobs):
    reports = [check(name, numbers) for name, numbers in jobs.items()]
    failures = {f"{r.name}:{k}": what for r in reports for k, what in r.failures.items()}
    assert not failures
    systems, compared = (sum(getattr(r, key) for r in reports) for key in ("systems", "compared"))
    print(f"{systems} systems, {compared} compared, {1 - compared / systems:.1%} excluded")
    assert compared >= 0.95 * systems
    assert sum(r.events for r in reports) >= 5 * compared


def test_random_systems():
    agree({"dips": range(16), "hop": range(16), "switch": range(16)})


@pytest.mark.slow
def test_a_thousand_random_systems():
    agree(shares(1000))


# The loop over scipy, against formulas.


def line(**guard) -> tuple[Plan, Sample]:
    """x' = 1 from x = 0 at t = 0; an event takes one away from x."""
    numbers = arrow(np.random.default_rng(0), 1, 1, m=np.zeros(2), V=np.zeros((1, 2)))
    numbers |= {"n": np.zeros(1), "c": 0.0, "R": np.eye(1), "r": -np.ones(1)} | guard
    start = Start(0.0, np.zeros(1), np.zeros(2), 4.5)
    return Plan((1,), (Arrow(0, 0, "rising"),)), Sample([still(1, b=np.ones(1))], [numbers], start)


def follow(plan, sample, events=4):
    run = scipy_loop.run(plan, sample, events, 1e-13, 1e-14)
    return [e.t for e in run.events], [e.after[0] for e in run.events], run


def test_the_loop_finds_events_of_a_line():
    times, after, run = follow(*line(n=np.ones(1), c=-0.75))
    np.testing.assert_allclose(times, [0.75, 1.75, 2.75, 3.75], atol=1e-14)
    np.testing.assert_allclose(after, -0.25, atol=1e-14)
    assert run.excluded is None and run.chart == 0


@pytest.mark.parametrize("width", [0.3, 1e-2, 1e-4])
def test_the_loop_finds_thin_dips(width):
    """(x - 1.2)^2 - width^2 falls through zero a width before x = 1.2."""
    plan, sample = line(n=np.array([-2.4]), Q=np.array([[2.0]]), c=1.44 - width**2)
    plan = plan._replace(arrows=(Arrow(0, 0, "falling"),))
    times, _, run = follow(plan, sample, 2)
    np.testing.assert_allclose(times, [1.2 - width, 2.2 - width], atol=1e-10)
    assert run.excluded == ("grazing" if width < 1e-3 else None)


def test_the_loop_follows_a_clock_and_says_what_is_too_close():
    plan, sample = line(n=np.ones(1), c=-0.75, period=0.5, offset=0.2)
    clock = plan._replace(arrows=(Arrow(0, 0, "scheduled"),))
    times, _, run = follow(clock, sample)
    np.testing.assert_allclose(times, [0.2, 0.7, 1.2, 1.7], atol=1e-15)
    assert run.excluded is None
    both = plan._replace(arrows=(plan.arrows[0], Arrow(0, 0, "scheduled")))
    numbers = sample.arrows[0] | {"period": 0.75 + 1e-7}
    close = sample._replace(arrows=[sample.arrows[0], numbers | {"offset": 0.0}])
    assert follow(both, close)[2].excluded == "events too close"
    twins = plan._replace(arrows=plan.arrows * 2)
    later = sample.arrows[0] | {"c": -0.75 - 1e-7}
    close = sample._replace(arrows=[sample.arrows[0], later])
    assert follow(twins, close)[2].excluded == "events too close"
