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


def to_design(
    cosines: Candidates,
    power: Float[np.ndarray, " K"],
    use: Float[np.ndarray, " K"],
    experiments: int,
    usual: Design,
    seed: int,
) -> Design:
    """Experiments in which each cosine has this power on the average, and which all take the same
    share of what is limited. No two cosines of one class meet in an experiment; where a class has
    fewer than there are experiments, strong ones stand in several.

    **Arguments:** `power`, zero for cosines that are not applied; `use`, the share of what is
    limited that each takes.
    """
    rng = np.random.default_rng(seed)
    classes = line_class(cosines.line, cosines.periods)
    share = np.zeros((len(power), experiments))
    for one in np.unique(classes[power > 0]):
        here = np.flatnonzero((power > 0) & (classes == one))
        counts = _counts(use[here], experiments)
        order = rng.permutation(experiments)[: counts.sum()]
        share[np.repeat(here, counts), order] = 1.0
    share *= (use / np.maximum(share.sum(axis=1), 1))[:, None]
    for _ in range(_SWEEPS):
        share *= use.sum() / experiments / share.sum(axis=0)
        share *= (use / np.where(use > 0, share.sum(axis=1), 1.0))[:, None]
    share[share < _WEAK * share.max(axis=1, keepdims=True)] = 0.0
    member, experiment = np.nonzero(share)
    order = np.lexsort((cosines.channel[member], cosines.line[member], experiment))
    member, experiment = member[order], experiment[order]
    part = share[member, experiment] / share.sum(axis=1)[member]
    return Design(
        experiment=experiment,
        line=cosines.line[member],
        channel=cosines.channel[member],
        amplitude=np.sqrt(2 * experiments * power[member] * part),
        phase=rng.uniform(0, 2 * np.pi, len(member)),
        n_sections=cosines.n_sections,
        periods=cosines.periods,
        experiments=experiments,
        input_names=usual.input_names,
    )


def _counts(use: Float[np.ndarray, " k"], experiments: int) -> Int[np.ndarray, " k"]:
    """In how many experiments each cosine of a class stands: all of them are used, in proportion to
    `use`, each cosine once at least."""
    counts = np.ones(len(use), int)
    for _ in range(experiments - len(use)):
        counts[np.argmax(use / counts)] += 1
    return counts
