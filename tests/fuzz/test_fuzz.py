"""Random hybrid systems: hybridjax and an event loop over scipy see the same events."""

import pytest

from .campaign import check, shares


def agree(jobs):
    reports = [check(name, numbers) for name, numbers in jobs.items()]
    assert not {
        f"{r.name}:{k}": what for r in reports for k, what in r.failures.items()
    }
    systems, compared = (
        sum(getattr(r, key) for r in reports) for key in ("systems", "compared")
    )
    print(
        f"{systems} systems, {compared} compared, {1 - compared / systems:.1%} excluded"
    )
    assert compared >= 0.95 * systems
    assert sum(r.events for r in reports) >= 5 * compared


def test_random_systems():
    agree({"dips": range(8)})


@pytest.mark.slow
def test_a_thousand_random_systems():
    agree(shares(1000))


def test_an_event_is_where_its_guard_falls():
    """A random system that once failed (in this file, so that it shares the compiled program)."""
    assert not check("dips", [28], seed=5, accuracy=1e-10).failures
