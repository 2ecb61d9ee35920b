"""Whether the outputs answer the input, and do so in all parts of a recording."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..data import SectionData
from .finding import Finding, listed


# Samples of a cycle from which the next one is predicted: the first number for which there are
# enough cycles. Doubled: more cycles are needed.
_SECTIONS = 8, 4, 2
# Cycles of a part, at least, and parts of a record, at most. Doubled: what happens in a short while
# is not seen; or it is, where recordings are long.
_SHORTEST, _PARTS = 16, 4
# Cycles per unknown. Doubled: nothing is said of short recordings.
_ENOUGH = 3
# Of the mean variance of the regressors, what is added to each of them. Doubled: inputs of narrow
# bands are told apart less well.
_RIDGE = 1e-4
# Of the median rms of an input, that of a part with pushes. Doubled: parts with weak pushes do not
# count.
_PUSHED = 0.1
# Outputs are cut off at so many robust standard deviations (1.4826 median moduli for a normal
# distribution), and these are at least this part of the rms. Doubled: spikes matter more.
_LARGEST, _MAD, _LEAST = 8.0, 1.4826, 0.1
# Standard errors that are beyond doubt. Doubled: weaker answers pass for none.
_CLEAR = 4.0
# Of the usual gain, what is odd; and what is none. Doubled: what is displaced by little is
# reported; or what has a weak answer.
_ODD, _NONE = 0.8, 0.4
# Of what is left unexplained where all inputs are displaced as is best for all parts, what is left
# where a part's own input is displaced as is best for that part, if that is right. Doubled: more is
# reported, also by chance.
_BETTER = 0.5
# How many times the usual power such a part leaves unexplained, at least. Doubled: what is
# displaced by little passes.
_WORSE = 1.5
# How many times the usual power is left unexplained where something else acted, and what share of
# what the input explains is much. Doubled: weaker disturbances pass.
_DISTURBED, _MUCH = 9.0, 0.25


class _Part(NamedTuple):
    """A part of a record, in whole cycles from section 0; outputs at K of the N sections."""

    trial: int
    start: float
    end: float
    u: Float[np.ndarray, "T N nu"]
    y: Float[np.ndarray, "T Kny"]
    sections: int
    """K."""
    rows: Int[np.ndarray, " t"]
    """Cycles that are predicted: all that is needed for them is known."""
    ahead: int
    """Cycles by which an input may come later than what it explains, by the lead of the record."""

    def inputs(self, i: int, displaced: int = 0) -> Float[np.ndarray, "t k"]:
        """What explains these cycles of an input that is displaced by some sections."""
        T, N = self.u.shape[:2]
        u = np.roll(self.u[..., i].reshape(-1), displaced).reshape(T, N)
        u = np.stack([x.mean(axis=1) for x in np.array_split(u, self.sections, axis=1)], 1)
        return _deviations([u[self.rows + c] for c in range(-1, self.ahead + 1)])


def unanswered(data: SectionData, names: tuple[str, ...]) -> list[Finding]:
    """Inputs that the outputs do not answer: in all trials, or in parts of them.

    Each cycle is predicted from the one before and from the inputs, linearly, as learned from the
    other trials (or the other parts of a single one). A part's gain is how much of what is
    predicted from an input happens: about 1. An input of another trial has a gain of 0, one with
    the other sign one of -1, and the gain of one that is displaced in time grows where it is put
    back. Standard errors come from the residuals, cycle by cycle.

    **Arguments:** `names`: of the trials.
    """
    found = []
    for i, name in enumerate(data.inputs):
        for sections in _SECTIONS:
            parts = [p for r in range(len(data.records)) for p in _parts(data, r, sections)]
            size = [float(p.u[..., i].std()) for p in parts]
            pushed = [p for p, x in zip(parts, size, strict=True) if x > _PUSHED * np.median(size)]
            answers = _answers(pushed, i)
            if answers:
                found += _odd(name, answers, names)
                break
    return found


def _odd(name: str, answers: list["_Answer"], names: tuple[str, ...]) -> list[Finding]:
    """What is odd about the gains of an input."""
    gain, error = np.array([a.gain() for a in answers]).T
    weight = error**-2.0
    usual = float(np.median(gain))
    together = abs(weight @ gain) / np.sqrt(weight.sum())
    if together < _CLEAR and np.mean((gain / error) ** 2) < _CLEAR:
        text = (
            f"the outputs do not answer {name}: look whether it was recorded in these trials, and "
            "at the same times."
        )
        return [Finding("no answer", "warned", text)]
    left, explained = np.array([a.unexplained() for a in answers]).T
    disturbed = left > np.maximum(_DISTURBED * np.median(left), _MUCH * explained)
    N = answers[0].part.u.shape[1]
    moves = np.arange(N) - N // 2
    moved = np.array([[a.unexplained(int(m))[0] for m in moves] for a in answers])
    common = moved[:, np.argmin(moved.sum(axis=0))]
    displaced = (moved.min(axis=1) < _BETTER * common) & (common > _WORSE * np.median(common))
    spans: dict[str, list[str]] = {}
    for k, a in enumerate(answers):
        best = int(moves[np.argmin(moved[k])])
        answer, unsure = a.gain(best)
        clear = answer > _CLEAR * unsure and np.divide(*a.unexplained(best)) < _MUCH
        verdict = ""
        if gain[k] < -max(_NONE * usual, _CLEAR * error[k]):
            verdict = "sign"
        elif displaced[k] and clear:
            verdict = "displaced"
        elif gain[k] < _NONE * usual and gain[k] + _CLEAR * error[k] < _ODD * usual:
            verdict = "none"
        elif disturbed[k]:
            verdict = "disturbed"
        if verdict:
            where = f"trial '{names[a.part.trial]}', {a.part.start:.4g}-{a.part.end:.4g} s"
            spans.setdefault(verdict, []).append(where)
    return [_finding(name, verdict, where) for verdict, where in spans.items()]


def _finding(name: str, verdict: str, where: list[str]) -> Finding:
    place = listed(where)
    if verdict == "sign":
        text = f"the outputs answer {name} with the other sign ({place}): turn it."
        return Finding("another sign", "refused", text)
    if verdict == "displaced":
        text = (
            f"the outputs answer {name} earlier or later than elsewhere ({place}): look at the "
            "clocks of the instruments."
        )
        return Finding("displaced input", "warned", text)
    if verdict == "none":
        text = (
            f"the outputs do not answer {name}, but do elsewhere ({place}): it may be that of "
            "another trial."
        )
        return Finding("foreign input", "warned", text)
    text = (
        f"something else than {name} moved the outputs ({place}): a push that was not recorded, a "
        "stumble, a sensor that failed."
    )
    return Finding("disturbed", "warned", text)


class _Answer(NamedTuple):
    """What the outputs of a part do beyond what the cycle before and the other inputs explain, and
    how an input is learned to explain it."""

    part: _Part
    i: int
    rest: Float[np.ndarray, "t Kny"]
    learned: Float[np.ndarray, "k Kny"]

    def gain(self, displaced: int = 0) -> tuple[float, float]:
        """How much of what is predicted from the input happens, and its standard error."""
        predicted = self.part.inputs(self.i, displaced) @ self.learned
        power = float((predicted**2).sum())
        gain = float((self.rest * predicted).sum()) / power
        each = ((self.rest - gain * predicted) * predicted).sum(axis=1)
        return gain, float(np.sqrt((each**2).sum())) / power

    def unexplained(self, displaced: int = 0) -> tuple[float, float]:
        """The mean square of what is not predicted, and of what is predicted from the input."""
        predicted = self.part.inputs(self.i, displaced) @ self.learned
        return float(((self.rest - predicted) ** 2).mean()), float((predicted**2).mean())


def _answers(parts: list[_Part], i: int) -> list[_Answer]:
    """Each part's, learned from other trials; none if there are too few cycles to learn from."""
    sides, squares, products = [], [], []
    for p in parts:
        inputs = [p.inputs(k) for k in range(p.u.shape[2])]
        x = np.concatenate([_deviations([p.y[p.rows - 1]]), *inputs], axis=1)
        sides.append(x)
        squares.append(x.T @ x)
        products.append(x.T @ _deviations([p.y[p.rows]]))
    answers = []
    for n, part in enumerate(parts):
        others = [k for k, p in enumerate(parts) if p.trial != part.trial]
        others = others or [k for k in range(len(parts)) if k != n]
        unknown = sides[n].shape[1]
        if sum(len(sides[k]) for k in others) < _ENOUGH * unknown:
            return []
        square = sum(squares[k] for k in others)
        square = square + _RIDGE * np.trace(square) / unknown * np.eye(unknown)
        b = np.linalg.solve(square, sum(products[k] for k in others))
        own, wide = part.y.shape[1], part.inputs(i).shape[1]
        rows = slice(own + i * wide, own + (i + 1) * wide)
        rest = _deviations([part.y[part.rows]]) - sides[n] @ b + sides[n][:, rows] @ b[rows]
        answers.append(_Answer(part, i, rest, b[rows]))
    return answers


def _deviations(columns: list[Float[np.ndarray, "t _"]]) -> Float[np.ndarray, "t k"]:
    """Side by side, without their means: each part has a level of its own."""
    x = np.concatenate(columns, axis=1)
    return x - x.mean(axis=0)


def _parts(data: SectionData, r: int, sections: int) -> list[_Part]:
    """Of a record, without scales: inputs in their rms, outputs in robust standard deviations."""
    record, N = data.records[r], data.n_sections
    sections = min(N, sections)
    first = -record.first_section % N
    cycles = (len(record.u) - first) // N
    number = min(_PARTS, cycles // _SHORTEST)
    edges = np.linspace(0, cycles, number + 1).astype(int) if number else []
    size_u, size_y = data.rms()
    every = np.concatenate([x.y for x in data.records])
    size_y = np.maximum(_MAD * np.nanmedian(np.abs(every), axis=0), _LEAST * size_y)
    at = np.linspace(0, N, sections, endpoint=False).astype(int)
    ahead = -(-record.lead // N)
    parts = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        where = slice(first + a * N, first + b * N)
        u = (record.u[where] / size_u).reshape(b - a, N, -1)
        y = (record.y[where] / size_y).reshape(b - a, N, -1)[:, at].reshape(b - a, -1)
        y = np.clip(y, -_LARGEST, _LARGEST)
        known = np.isfinite(u).all(axis=(1, 2))
        rows = np.arange(1, b - a - ahead)
        used = [known[rows + c] for c in range(-1, ahead + 1)]
        used += [np.isfinite(y[rows + c]).all(axis=1) for c in (-1, 0)]
        rows = rows[np.stack(used).all(axis=0)]
        t = data.times[r][where]
        u, y = np.nan_to_num(u), np.nan_to_num(y)
        part = _Part(data.trials[r], float(t[0]), float(t[-1]), u, y, sections, rows, ahead)
        parts += [part] if len(rows) >= _SHORTEST / 2 else []
    return parts
