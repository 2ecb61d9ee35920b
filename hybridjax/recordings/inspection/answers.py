"""Do the outputs answer each input, alike in all parts of a recording, and was it exogenous?"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..data import SectionData
from ..findings import Finding, listed, place


# Numbers of outputs per cycle that are predicted: the first for which there are `_ENOUGH` cycles
# per unknown. More cycles: short recordings are not checked. Fewer: predictions are noise.
_SECTIONS, _ENOUGH = (8, 4, 2), 3
# Cycles of a part, at least, and parts of a record, at most. More: short faults are diluted, or
# long records take longer. Fewer: the gain of a part is noise.
_SHORTEST, _PARTS = 16, 4
# Standard errors that count as certain. Larger: weak answers pass for none. Smaller: chance is
# reported.
_CLEAR = 4.0
# Gains, relative to the median: below `_NONE` there is no answer, above `_ODD` it is usual. Larger:
# other gains are reported. Smaller: partly wrong inputs pass.
_ODD, _NONE = 0.8, 0.4
# Unexplained power where a part's input is displaced as is best for it, relative to the
# displacement that is best for all. Larger: displaced by chance. Smaller: real shifts pass.
_BETTER = 0.5
# Unexplained power of a part relative to the median that makes a disturbance, and relative to what
# the input explains. Larger: stumbles pass. Smaller: noisy parts are reported.
_DISTURBED, _MUCH = 9.0, 0.25
# Fraction of an input's variance that repeats with the cycle, from which on it is feedback.
# Larger: triggers pass. Smaller: it repeats by chance.
_REPEATS = 0.5


class _Part(NamedTuple):
    """A part of a record, in whole cycles from section 0; outputs at K of the N sections."""

    trial: int
    time: Float[np.ndarray, " n"]
    u: Float[np.ndarray, "T N nu"]
    y: Float[np.ndarray, "T Kny"]
    sections: int
    """K."""
    rows: Int[np.ndarray, " t"]
    """Cycles that can be predicted: all that is needed for them is known."""
    ahead: int
    """Cycles by which an input may come later than its response, by the lead of the record."""

    def inputs(self, i: int, displaced: int = 0) -> Float[np.ndarray, "t k"]:
        """Return the regressors from an input that is displaced by some sections."""
        T, N = self.u.shape[:2]
        u = np.roll(self.u[..., i].reshape(-1), displaced).reshape(T, N)
        u = np.stack([x.mean(axis=1) for x in np.array_split(u, self.sections, axis=1)], 1)
        return _centered([u[self.rows + c] for c in range(-1, self.ahead + 1)])


class _Answer(NamedTuple):
    """The outputs of a part, without what the cycle before and the other inputs explain, and the
    response to an input as learned from other parts."""

    part: _Part
    i: int
    outputs: Float[np.ndarray, "t Kny"]
    learned: Float[np.ndarray, "k Kny"]

    def gain(self, displaced: int = 0) -> tuple[float, float]:
        """Return the ratio of the actual to the predicted response, and its standard error."""
        predicted = self.part.inputs(self.i, displaced) @ self.learned
        power = float((predicted**2).sum())
        gain = float((self.outputs * predicted).sum()) / power
        each = ((self.outputs - gain * predicted) * predicted).sum(axis=1)
        return gain, float(np.sqrt((each**2).sum())) / power

    def unexplained(self, displaced: int = 0) -> tuple[float, float]:
        """Return the mean squares of the residual and of the predicted response."""
        predicted = self.part.inputs(self.i, displaced) @ self.learned
        return float(((self.outputs - predicted) ** 2).mean()), float((predicted**2).mean())


def unanswered(data: SectionData, names: tuple[str, ...]) -> Iterator[Finding]:
    """Find inputs that the outputs do not answer, in all trials or in parts of them.

    Each cycle is predicted linearly from the one before and from the inputs, as learned from the
    other trials (or the other parts of a single one). The gain of a part is the ratio of actual to
    predicted response: about 1, but 0 for the input of another trial, -1 for the other sign; that
    of an input that is displaced in time grows where the displacement is undone. Standard errors
    come from the residuals, cycle by cycle.

    **Arguments:** `names`: names of the trials.
    """
    for i, name in enumerate(data.inputs):
        for sections in _SECTIONS:
            parts = [p for r in range(len(data.records)) for p in _parts(data, r, sections)]
            size = [float(p.u[..., i].std()) for p in parts]
            pushed = [p for p, x in zip(parts, size, strict=True) if x > 0.1 * np.median(size)]
            answers = _answers(pushed, i)
            if answers:
                yield from _odd(name, answers, names)
                break


def _odd(name: str, answers: list[_Answer], names: tuple[str, ...]) -> Iterator[Finding]:
    """Find odd gains of an input."""
    gain, error = np.array([a.gain() for a in answers]).T
    usual = float(np.median(gain))
    together = abs(error**-2.0 @ gain) / np.sqrt((error**-2.0).sum())
    if together < _CLEAR and np.mean((gain / error) ** 2) < _CLEAR:
        yield Finding("no answer", f"the outputs do not answer {name}: was it recorded with them?")
        return
    left, explained = np.array([a.unexplained() for a in answers]).T
    N = answers[0].part.u.shape[1]
    moves = np.arange(N) - N // 2
    moved = np.array([[a.unexplained(int(m))[0] for m in moves] for a in answers])
    common = moved[:, np.argmin(moved.sum(axis=0))]
    worse = common > 1.5 * np.median(common)  # where nothing is left, nothing is displaced
    where: dict[str, list[str]] = {}
    for k, a in enumerate(answers):
        best = int(moves[np.argmin(moved[k])])
        answer, uncertain = a.gain(best)
        clear = answer > _CLEAR * uncertain and np.divide(*a.unexplained(best)) < _MUCH
        if gain[k] < -max(_NONE * usual, _CLEAR * error[k]):
            cause = "another sign"
        elif worse[k] and moved[k].min() < _BETTER * common[k] and clear:
            cause = "displaced input"
        elif gain[k] < _NONE * usual and gain[k] + _CLEAR * error[k] < _ODD * usual:
            cause = "foreign input"
        elif left[k] > max(_DISTURBED * np.median(left), _MUCH * explained[k]):
            cause = "disturbed"
        else:
            continue
        where.setdefault(cause, []).append(place(names[a.part.trial], a.part.time))
    texts = {
        "another sign": "the outputs answer {} with the other sign ({}): turn it.",
        "displaced input": "the outputs answer {} earlier or later than elsewhere ({}).",
        "foreign input": "the outputs do not answer {}, but do elsewhere ({}).",
        "disturbed": "something else than {} moved the outputs ({}).",
    }
    for cause, spans in where.items():
        text = texts[cause].format(name, listed(spans))
        yield Finding(cause, text, "refused" if cause == "another sign" else "warned")


def _answers(parts: list[_Part], i: int) -> list[_Answer]:
    """Return the answer of each part, learned from other trials; none if there are too few."""
    regressors, squares, products = [], [], []
    for p in parts:
        inputs = [p.inputs(k) for k in range(p.u.shape[2])]
        x = np.concatenate([_centered([p.y[p.rows - 1]]), *inputs], axis=1)
        regressors.append(x)
        squares.append(x.T @ x)
        products.append(x.T @ _centered([p.y[p.rows]]))
    answers = []
    for n, part in enumerate(parts):
        training = [k for k, p in enumerate(parts) if p.trial != part.trial]
        training = training or [k for k in range(len(parts)) if k != n]
        unknowns = regressors[n].shape[1]
        if sum(len(regressors[k]) for k in training) < _ENOUGH * unknowns:
            return []
        square = np.sum([squares[k] for k in training], axis=0)
        square += 1e-4 * np.trace(square) / unknowns * np.eye(unknowns)  # of collinear inputs
        b = np.linalg.solve(square, np.sum([products[k] for k in training], axis=0))
        ny, wide = part.y.shape[1], part.inputs(i).shape[1]
        rows = slice(ny + i * wide, ny + (i + 1) * wide)
        outputs = _centered([part.y[part.rows]]) - regressors[n] @ b
        answers.append(_Answer(part, i, outputs + regressors[n][:, rows] @ b[rows], b[rows]))
    return answers


def _centered(columns: list[Float[np.ndarray, "t _"]]) -> Float[np.ndarray, "t k"]:
    """Join columns without their means: each part has a level of its own."""
    x = np.concatenate(columns, axis=1)
    return x - x.mean(axis=0)


def _parts(data: SectionData, r: int, sections: int) -> list[_Part]:
    """Return the parts of a record, inputs in their rms, outputs in robust standard deviations."""
    record, N = data.records[r], data.n_sections
    sections = min(N, sections)
    first = -record.first_section % N
    cycles = (len(record.u) - first) // N
    number = min(_PARTS, cycles // _SHORTEST)
    edges = np.linspace(0, cycles, number + 1).astype(int) if number else np.zeros(0, int)
    size_u, size_y = data.rms()
    robust = 1.4826 * np.nanmedian(np.abs(np.concatenate([x.y for x in data.records])), axis=0)
    size_y = np.maximum(robust, 0.1 * size_y)  # (more than half of the samples may be zero)
    at = np.linspace(0, N, sections, endpoint=False).astype(int)
    ahead = -(-record.lead // N)
    parts = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        where = slice(first + a * N, first + b * N)
        u = (record.u[where] / size_u).reshape(b - a, N, -1)
        y = (record.y[where] / size_y).reshape(b - a, N, -1)[:, at].reshape(b - a, -1)
        y = np.clip(y, -8, 8)  # outliers
        finite_u = np.asarray(np.isfinite(u).all(axis=(1, 2)))
        finite_y = np.asarray(np.isfinite(y).all(axis=1))
        rows = np.arange(1, b - a - ahead)
        used = [finite_u[rows + c] for c in range(-1, ahead + 1)]
        used += [finite_y[rows - 1], finite_y[rows]]
        rows = rows[np.stack(used).all(axis=0)]
        u, y, time = np.nan_to_num(u), np.nan_to_num(y), data.times[r][where]
        if len(rows) >= _SHORTEST / 2:
            parts.append(_Part(data.trials[r], time, u, y, sections, rows, ahead))
    return parts


def feedback(data: SectionData) -> Iterator[Finding]:
    """Find inputs that repeat with the rhythm.

    An input chosen without regard to the rhythm averages out over many cycles. One whose average
    cycle holds most of its variance was made from the rhythm's phase or state, by a controller or a
    trigger: its deviations then depend on those of the outputs, and on their disturbances, and no
    regression on it is unbiased (Söderström and Stoica, *System Identification*, 1989, ch. 10:
    direct identification in closed loop).
    """
    if data.cycles < 6:
        return
    deviations, _ = data.rms()
    for i, name in enumerate(data.inputs):
        repeated = float(np.nanvar(data.cycle_inputs[:, i]))
        share = repeated / max(repeated + float(deviations[i]) ** 2, np.finfo(float).tiny)
        if share > _REPEATS:
            yield Finding(
                "feedback",
                f"{100 * share:.0f} % of the variance of {name} repeats with the cycle: it is not "
                "exogenous, and fits are biased. Add a perturbation, and name that as the input.",
            )
