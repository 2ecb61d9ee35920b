"""From powers of cosines to experiments."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..experiments.design.design import Design
from ..experiments.design.partition import line_class
from .candidates import Candidates


# Sweeps by which experiments are brought to the same power: to 1e-6 or better.
_SWEEPS = 100
# What these leave of a cosine in an experiment, relative to its largest share, to be nothing.
# Doubled: experiments differ in power by as little.
_WEAK = 1e-4


def worthwhile(
    cosines: Candidates, gain: Float[np.ndarray, " K"], experiments: int, negligible: float
) -> Bool[np.ndarray, " K"]:
    """The cosines that matter, and that so many experiments can hold: of each class of lines that
    disturb each other the best ones.

    **Arguments:** `gain`, what each tells; `negligible`, the part of it that is left out.
    """
    order = np.argsort(gain)
    kept = np.empty(len(gain), bool)
    kept[order] = np.cumsum(gain[order]) > negligible * gain.sum()
    classes = line_class(cosines.line, cosines.periods)
    for one in np.unique(classes):
        here = np.flatnonzero(kept & (classes == one))
        kept[here[np.argsort(gain[here])][: max(len(here) - experiments, 0)]] = False
    return kept


def places(
    cosines: Candidates,
    use: Float[np.ndarray, " K"],
    need: Float[np.ndarray, " K"],
    experiments: int,
) -> Int[np.ndarray, " K"]:
    """In how many experiments each cosine stands. No two of one class meet in an experiment; where
    there is room, strong ones stand in several.

    **Arguments:** `use`, the share of what is limited that each takes; `need`, as many experiments
    as it fills with the largest amplitude that it may have. Where a class needs more than there
    are, strong ones get fewer: numerators need all lines.
    """
    classes = line_class(cosines.line, cosines.periods)
    counts = np.zeros(len(use), int)
    for one in np.unique(classes):
        here = classes == one
        counts[here] = _counts(use[here], need[here], experiments)
    return counts


def to_design(
    cosines: Candidates,
    power: Float[np.ndarray, " K"],
    use: Float[np.ndarray, " K"],
    counts: Int[np.ndarray, " K"],
    largest: Float[np.ndarray, " K"],
    experiments: int,
    usual: Design,
    seed: int,
) -> Design:
    """Experiments in which each cosine has this power on the average, and which all take the same
    share of what is limited.

    **Arguments:** `use` and `counts`, as of `places`; `largest`, the amplitude that no cosine
    exceeds in an experiment.
    """
    rng = np.random.default_rng(seed)
    # Part of its power that a cosine may have in one experiment.
    most = largest**2 / (2 * experiments * power)
    classes = line_class(cosines.line, cosines.periods)
    share = np.zeros((len(power), experiments))
    for one in np.unique(classes):
        here = np.flatnonzero(classes == one)
        order = rng.permutation(experiments)[: counts[here].sum()]
        share[np.repeat(here, counts[here]), order] = 1.0
    share *= (use / counts)[:, None]
    even = share
    for _ in range(_SWEEPS):
        share = share * (use.sum() / experiments / share.sum(axis=0))
        share *= (use / share.sum(axis=1))[:, None]
    # As far from even shares as the largest amplitudes allow.
    room, more = (use * most)[:, None] - even, share - even
    part = np.min(np.divide(room, more, out=np.full(even.shape, np.inf), where=more > 0), axis=1)
    share = even + np.clip(part, 0, 1)[:, None] * more
    share[share < _WEAK * share.max(axis=1, keepdims=True)] = 0.0
    member, experiment = np.nonzero(share)
    order = np.lexsort((cosines.channel[member], cosines.line[member], experiment))
    member, experiment = member[order], experiment[order]
    part = share[member, experiment] / share.sum(axis=1)[member]
    amplitude = np.sqrt(2 * experiments * power[member] * part)
    return Design(
        experiment=experiment,
        line=cosines.line[member],
        channel=cosines.channel[member],
        amplitude=np.minimum(amplitude, largest[member]),
        phase=rng.uniform(0, 2 * np.pi, len(member)),
        n_sections=cosines.n_sections,
        periods=cosines.periods,
        experiments=experiments,
        input_names=usual.input_names,
    )


def _counts(
    use: Float[np.ndarray, " k"], need: Float[np.ndarray, " k"], experiments: int
) -> Int[np.ndarray, " k"]:
    """For cosines of one class. All experiments are used."""
    counts = np.maximum(np.ceil(need - _WEAK), 1).astype(int)
    while counts.sum() > experiments:
        counts[np.argmax(np.where(counts > 1, counts - need, -np.inf))] -= 1
    while counts.sum() < experiments:
        counts[np.argmax(use / counts)] += 1
    return counts
