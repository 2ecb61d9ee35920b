"""The steps of an analysis one by one, each against the same at a tolerance of 1e-14."""

import functools as ft

import numpy as np

import hybridjax as hj

from .problems import HOPPER, OUTPUTS, cycle, first_and_later, sections


TIGHT = hj.orbits.Settings(rtol=1e-14, atol=1e-14)


def run(show, options) -> None:
    tight = hj.find_limit_cycle(hj.models.VerticalHopper(), settings=TIGHT)
    hopper = hj.models.VerticalHopper()
    found, _, seconds = first_and_later(
        lambda: hj.find_limit_cycle(hopper), options.repeat
    )
    show("find_limit_cycle.wall", seconds.wall)
    show("find_limit_cycle.error", _distance(found.anchor.q, tight.anchor.q))
    show(
        "find_limit_cycle.multiplier_error",
        _distance(found.multipliers, tight.multipliers),
    )
    f = hj.experiments.paper_design().frequencies[:: 50 if options.quick else 10]
    found = cycle("hopper")
    for model, family in HOPPER:
        own = sections(model, family)
        name = f"place_sections.{family}"
        work = ft.partial(hj.sections.place_sections, found, own)
        placed, _, seconds = first_and_later(work, options.repeat)
        show(f"{name}.wall", seconds.wall)
        finer = hj.sections.place_sections(tight, own)
        show(f"{name}.error", _distance(placed.lanes.q, finer.lanes.q))
        name = f"linearize.{family}"
        work = ft.partial(hj.linearize, found, placed, OUTPUTS[model])
        ldtp, _, seconds = first_and_later(work, options.repeat)
        show(f"{name}.wall", seconds.wall)
        exact = hj.linearize(tight, finer, OUTPUTS[model])
        show(f"{name}.htf_error", float(np.max(ldtp.htf(f).error(exact.htf(f)))))


def _distance(a, b) -> float:
    return float(np.max(np.abs(np.asarray(a) - np.asarray(b))))
