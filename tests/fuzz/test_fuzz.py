"""Random hybrid systems: hybridjax and an event loop over scipy see the same events."""

import pytest

from .campaign import check, shares


def agree(jobs):
    reports = [check(name, numbers) for name, numbers in jobs.items()]
    for report in reports:
        assert not report.failures, report.name
    systems = sum(report.systems for report in reports)
    compared = sum(report.compared for report in reports)
    events = sum(report.events for report in reports)
    print(f"{systems} systems, {compared} compared")
    assert compared >= 0.95 * systems, "few are excluded"
    assert events >= 5 * compared, "there are many events"


def test_random_systems():
    agree({"dips": range(8)})


@pytest.mark.slow
def test_a_thousand_random_systems():
    agree(shares(1000))


def test_an_event_is_where_its_guard_falls():
    """A random system that once failed (in this file, so that it shares the compiled program)."""
    assert not check("dips", [28], seed=5, accuracy=1e-10).failures
