"""What it costs to check the arguments of public functions, beside beartype, and as a share of
calls that compute.

    python benchmarks/boundary.py
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal

import numpy as np
from beartype import beartype

import hybridjax as hj
from hybridjax._core.boundary.checked import checked
from hybridjax._core.boundary.kinds import (
    Count,
    Index,
    Numbers,
    Order,
    Positive,
    SignalNames,
)
from hybridjax._core.boundary.values import Reals


def count(n: Count): ...


def words(
    start: Literal["free", "cycle"], names: SignalNames, scale: Mapping[str, Positive]
): ...


def records(
    data: hj.experiments.SectionSeries | Sequence[hj.experiments.SectionSeries],
    order: Order | hj.linear.LDTP,
    *,
    extra_lags: Index | None = None,
    start: Literal["free", "cycle"] = "free",
    check: bool = True,
): ...


def array(u: Annotated[Numbers, Reals("S n nu")]): ...


def cases() -> dict[str, tuple[Callable, tuple, dict]]:
    """What is called, and with what."""
    record = hj.experiments.SectionSeries(
        np.ones((64, 1)), np.ones((64, 2)), n_sections=8
    )
    options = {"extra_lags": 3, "start": "cycle", "check": True}
    sizes = {"y": 1.0, "v": 2.0, "q": 3.0}
    return {
        "one integer": (count, (32,), {}),
        "a word, 2 names, 3 sizes": (words, ("free", ("yM", "vM"), sizes), {}),
        "fit_series, one record": (records, (record, 2), options),
        "fit_series, 20 records": (records, ([record] * 20, 2), options),
        "array of 1 000 numbers": (array, (np.ones((1, 1000, 1)),), {}),
        "array of 163 840 numbers": (array, (np.ones((80, 2048, 1)),), {}),
    }


def cost(function: Callable, args: tuple, kwargs: dict, seconds: float = 0.2) -> float:
    """CPU time of one call in microseconds: the least of five means."""
    function(*args, **kwargs)
    begin = time.process_time()
    function(*args, **kwargs)
    repeats = max(3, int(seconds / max(time.process_time() - begin, 1e-6)))
    means = []
    for _ in range(5):
        begin = time.process_time()
        for _ in range(repeats):
            function(*args, **kwargs)
        means.append((time.process_time() - begin) / repeats)
    return 1e6 * min(means)


def calls() -> dict[str, tuple[Callable, tuple, dict]]:
    """Public functions, and arguments with which they compute."""
    model, rng = hj.testing.synthetic_ldtp(), np.random.default_rng(0)
    u = rng.normal(size=(200 * model.n_sections, len(model.inputs)))
    y = np.asarray(model.simulate(u)) + 1e-3 * rng.normal(
        size=(len(u), len(model.outputs))
    )
    record = hj.experiments.SectionSeries(u, y, n_sections=model.n_sections)
    hopper = hj.models.VerticalHopper()
    cycle = hj.find_limit_cycle(hopper)
    return {
        "LDTP.simulate, 1200 samples": (hj.linear.LDTP.simulate, (model, u), {}),
        "LDTP.htf, 10 frequencies": (
            hj.linear.LDTP.htf,
            (model, np.linspace(0.1, 0.9, 10)),
            {},
        ),
        "fit_series, 200 cycles": (hj.fit_series, (record, 2), {}),
        "validate, 200 cycles": (hj.validate, (model, record), {}),
        "find_limit_cycle, hopper": (hj.find_limit_cycle, (hopper, cycle), {}),
        "place_sections, 8": (
            hj.sections.place_sections,
            (cycle, hj.ClockPhase(8)),
            {},
        ),
    }


def main() -> None:
    hj.enable_x64()
    print(f"{'microseconds':<28}{'checked':>9}{'beartype':>10}")
    for name, (function, args, kwargs) in cases().items():
        bare = cost(function, args, kwargs)
        own, other = (
            cost(f(function), args, kwargs) - bare for f in (checked, beartype)
        )
        print(f"{name:<28}{own:9.1f}{other:10.1f}")
    print(f"\n{'microseconds':<28}{'checks':>9}{'call':>10}{'share':>9}")
    for name, (function, args, kwargs) in calls().items():
        check = cost(lambda *a, f=function, **k: f.kinds.take(a, k), args, kwargs)
        whole = cost(function, args, kwargs)
        print(f"{name:<28}{check:9.1f}{whole:10.0f}{check / whole:9.2%}")


if __name__ == "__main__":
    main()
