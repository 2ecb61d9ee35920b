"""Multipliers of a plant (a simulator of another package) from returns of perturbed states to
section 0.

The *return* of a state is the state after one cycle, when the plant meets section 0 again.
Simulators with fixed time steps let contacts begin and end at the ends of steps. The return is then
a *staircase* as a function of the state: within one stair it has no noise, and a wrong slope.
Therefore the beginning of the time steps (the *grid*) is shifted from pair to pair of perturbed
states.

`cycle.py` first calls `ReturnMap.measure`, which finds the noise of returns and chooses step sizes.
It then calls `measured_returns`, which takes four stages:

1. `ReturnMap.solve` moves the state to the fixed point of the return.
2. `ReturnMap.all_slopes` measures central differences with several steps.
3. `_fitted` fits a Jacobian and its errors to these slopes.
4. `_eigenvalues` and `_resolved` find the multipliers that differ from 0, with their covariance.

Stages 2 to 4 are repeated with the longest steps if noise may hide a multiplier, and with shorter
steps if narrow and wide steps disagree. For a wrong multiplier, compare `ReturnMap.slopes` with a
known Jacobian, then each stage with the one before.

The constants may be changed: comments of most say what gets worse in either direction. `_STEPS`
must rise from 1, and have more entries than `_POWERS_OF_SCATTER`. Both states of a pair must have
the same grid, since its shift would count as a slope. `amplitude.py` calls `measure_ranges`,
`grid_may_move` and `changes_over_grids` without `measure`: they must not need what it finds.
"""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from .._core.arguments import require_among
from .._core.boundary.kinds import SignalNames
from .._core.findings import Finding
from .._core.progress import counted
from .._core.text import listed
from ..errors import ComputationError, DefinitionError
from ..identify.denominator import coefficients_of
from ..identify.multiplier_estimate import MultiplierFit
from ..linear.multipliers import conjugate_of, largest_first
from ..sections import families
from .drive import At


# Steps of the pairs of perturbed states, in units of the smallest one. Fewer: noise cannot be told
# from curvature. More: time. If the largest is only twice the smallest, narrow and wide steps
# hardly differ; if it is eight times the smallest, it leaves the linear range. Equal steps have no
# scatter if the grid is not shifted.
_STEPS = np.array([1.0, 1.2, 2.0, 2.4, 3.3, 4.0])
# The first four are narrow, the last four wide.
_NARROW = _STEPS <= _STEPS[3]
_WIDE = _STEPS >= _STEPS[2]
# The noise of slopes is their scatter about a polynomial with this many even powers of the step,
# the constant included. Fewer: curvature counts as noise. More: few degrees of freedom remain.
_POWERS_OF_SCATTER = 3
# All steps are repeated until coordinates times repetitions reach this number. Smaller: the noise
# of one coordinate is known from six pairs only. Larger: more time for few coordinates.
_COLUMNS = 4
# Upper limit of the smallest step, as a part of the range of a coordinate. Larger: the widest
# steps, four times as long, leave the linear range. Smaller: contacts begin at the same time step
# for all perturbed states, so that the staircase is not seen.
_MOST_OF_SMALLEST_STEP = 0.01
# Number of shifts of the grid at which its noise is measured. Fewer: stairs between two shifts are
# missed. More: time.
_GRIDS = 8
# Shifts of the grid (in steps) with which it is tested whether the plant can be shifted. With a
# single one, a plant whose own steps divide this shift would not show its grid.
_TRIED = (0.381966, 0.618034)
# The grid is shifted only if returns then change by less than this part of the range. Larger:
# controllers that count time steps are disturbed. Smaller: errors of integration count as a
# disturbance.
_GRID_ERROR = 0.03
# Assumed bias of the Jacobian, in units of the difference between narrow and wide steps. (It is 1.8
# for a jump of the second derivative, and 0.8 for a fifth derivative.) Smaller: regions are too
# small near such a jump.
_BIAS = 1.8
# A multiplier differs from 0, and narrow steps differ from wide steps, if the difference exceeds
# this many standard errors. Smaller: noise is listed as a multiplier. Larger: multipliers are not
# listed.
_RESOLVED = 3.0
# Relative difference of a multiplier between narrow and wide steps above which there is a finding.
# Smaller: harmless curvature, which the errors contain, gives a finding.
_APART = 0.1
# Difference of a multiplier between narrow and wide steps, relative to the largest multiplier,
# above which shorter steps are tried. Smaller: twice the time for a few digits. Larger: wide
# regions.
_CURVED = 0.01
# Rounding error of a well-conditioned eigenvalue, in units of the norm of the Jacobian. Smaller:
# rounding is listed as multipliers. Larger: small multipliers of smooth plants hide.
_ROUNDING = 1e-13
# A state is on the cycle if its residual, in units of the range, is below this. Smaller: tolerances
# of integrators give a finding. Larger: multipliers of another orbit.
_RESIDUAL = 1e-5
# Multipliers below this modulus may hide without a finding. Smaller: plants that forget everything
# in one cycle give a finding. Larger: important multipliers hide.
_SMALL = 0.05
# A range of a coordinate below this part of the largest number of the state is a rounding error.
# Larger: motions in small units count as rest. Smaller: differences of rounding errors count as
# slopes.
_REST = 1e-13
_DRAWS = 1000


class Returns(MultiplierFit):
    """Multipliers from returns of perturbed states to section 0.

    **Fields** beside those of all fits of multipliers:

    - `coordinates`: names of the numbers that were perturbed.
    - `travelling`: names of coordinates that grow in each cycle and on which nothing depends, such
      as the distance walked. Their multipliers are 1 and are not listed.
    - `noise` (d,): standard deviation of each coordinate in returns from nearly equal states.
    - `residual`: largest distance between state and return, in units of the range of the
      coordinate on the cycle.
    - `bound`: the largest modulus that multipliers may have that are not listed, because they
      cannot be distinguished from 0. It is 0 if all are listed.
    - `findings`: multipliers that noise may hide, and steps that give different multipliers.
    """

    noise: Float[np.ndarray, " d"]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    residual: float = eqx.field(static=True)
    bound: float = eqx.field(static=True)
    travelling: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def model(self) -> None:
        return None

    def _about(self) -> str:
        count = len(self.coordinates)
        about = (
            f"{count - len(self.multipliers)} more below {self.bound:.1g}; {count} coordinates, "
            f"residual {self.residual:.1g}"
        )
        if self.travelling:
            about += f"; left out, because they travel: {listed(self.travelling)}"
        return about


class ReturnMap:
    """The return map of some coordinates of a plant on section 0, and its fixed point.

    **Fields:** `names`: names of the coordinates. `x`: values of the coordinates, at first those of
    the settled state. `signals`: signals of the plant after the last return. Five fields are known
    after `measure`: `travelling`, names of coordinates that grow in each cycle and on which nothing
    depends; `size`, ranges of the coordinates on the cycle; `noise`, standard deviation of returns;
    `tolerance`, standard deviation of returns from nearly equal states, caused by rounding and by
    the tolerances of the plant; `h`, the smallest steps of differences.
    """

    def __init__(self, cycle: Any, names: SignalNames | None = None):
        plant = cycle.plant
        self.drive = cycle.drive
        if not self.drive.sets or self.drive.fixed:
            raise DefinitionError(
                "use a plant whose state can be set, with steps of any size."
            )
        self.base = np.array(cycle.state, float)
        numbered = [f"x{i}" for i in range(self.base.size)]
        states = tuple(getattr(plant, "states", numbered))
        period = getattr(plant, "period", None)
        self.chosen = bool(names)
        if not names:
            timeless = period is None or isinstance(cycle.sections, families.ClockPhase)
            names = tuple(x for x in states if not (timeless and x == "time"))
        require_among("coordinate", names, states, "perturbed_returns: ")
        self.names = tuple(names)
        self.columns = [states.index(x) for x in names]
        self.travelling = tuple[str, ...]()
        self.shift = np.zeros(len(names))
        if period is not None and "time" in names:
            turns = round(cycle.period / period)
            self.shift[names.index("time")] = turns * period
        self.x = self.base[self.columns]
        self.signals = np.array(cycle.drive.start.z, float)
        self.n = cycle.sections.n_sections
        self.moves_grid = False
        # (If the perturbation puts a state before its crossing, this crossing must not count as the
        # return.)
        self.free = cycle.period / 2 if self.drive.phase.crossings else 0.0

    def __call__(
        self,
        x: Float[np.ndarray, " d"],
        points: list[At] | None = None,
        first: float = 0.0,
    ) -> Float[np.ndarray, " d"]:
        """Return the coordinates after one cycle, and append the points of its steps.

        **Arguments:** `first`: length of a first, shorter step, in units of the plant's steps.
        """
        drive = self.drive
        state = self.base.copy()
        state[self.columns] = x
        drive.restore(drive.start._replace(state=state))
        drive.phase.begin(drive.t, drive.z, on_section=True)
        if first > 0:
            drive.step(drive.zero, first * drive.dt)
        if points is None:
            drive.pass_time(self.free)
        drive.advance(drive.zero, self.n, points)
        self.signals = np.array(drive.z, float)
        return np.array(drive.here().state, float)[self.columns] - self.shift

    def measure(self) -> None:
        """Measure the ranges of the coordinates and the noise of returns, and find the coordinates
        that travel, in about 70 cycles."""
        self.measure_ranges()
        self.tolerance, self.noise = self._noise()
        self._find_travelling()
        self.moves_grid = self.grid_may_move()
        if self.moves_grid:
            changes, _ = self.changes_over_grids()
            noise = np.std(changes, axis=0, ddof=1) / np.sqrt(2)
            self.noise = np.maximum(self.noise, noise)
        # Steps at which noise and the error of fourth order are nearly equal, for a function with
        # derivatives of magnitude 1.
        step = (self.noise / self.size).max() ** 0.2 / 2
        self.h = self.size * min(step, _MOST_OF_SMALLEST_STEP)

    def measure_ranges(self) -> None:
        """Measure the ranges of the coordinates, in one cycle."""
        points = list[At]()
        self(self.x, points)
        states = np.array([x.state for x in points], float)
        rows = states[:, self.columns]
        size = np.ptp(rows, axis=0)
        largest = np.abs(rows).max(axis=0)
        rounding = _REST * largest.max(initial=0)
        # (If a coordinate does not move, its size is its value, or 1 if it is zero.)
        rest = np.where(largest > rounding, largest, 1.0)
        moves = size > np.maximum(1e-9 * largest, rounding)
        self.size = np.where(moves, size, rest)

    def grid_may_move(self) -> bool:
        """Return whether the grid may be shifted, by a shorter first time step. (This disturbs a
        controller that counts time steps.)"""
        plain = self(self.x)
        moved = [self(self.x, first=part) for part in _TRIED]
        change = np.abs(np.array(moved) - plain)
        return bool((change <= _GRID_ERROR * self.size).all())

    def changes_over_grids(
        self,
    ) -> tuple[Float[np.ndarray, "grids d"], Float[np.ndarray, "grids signals"]]:
        """Return differences between the returns of two states, and between the signals after them,
        for several shifts of the grid.

        Within one stair of a simulator, returns from nearly equal states have no noise. With shifts
        of the grid, they do.
        """
        rng = np.random.default_rng(1)
        signs = rng.choice([-1, 1], len(self.x))
        move = 2 * _MOST_OF_SMALLEST_STEP * self.size * signs
        states = []
        signals = []
        for first in _grid_phases(rng, _GRIDS):
            above = self(self.x + move, first=first)
            signals_above = self.signals
            below = self(self.x - move, first=first)
            states.append(above - below)
            signals.append(signals_above - self.signals)
        return np.array(states), np.array(signals)

    def _find_travelling(self) -> None:
        """Find coordinates that grow in each cycle, as the distance walked does.

        If nothing depends on such a coordinate, it is left out, unless the user chose it. An angle
        that makes whole revolutions is kept, and its return is counted less one revolution.
        """
        first = self(self.x)
        second = self(first)
        advance = first - self.x
        again = second - first
        steady = np.abs(again - advance) <= np.maximum(
            10 * self.noise, 0.01 * np.abs(advance)
        )
        # (A state that is still settling does not advance at one rate.)
        noticeable = np.maximum(10 * self.noise, 1e-6 * self.size)
        grows = np.abs(advance) > noticeable
        grows = grows & steady
        tolerance = 10 * self.noise + 1e-6 * self.size
        travels = np.zeros(len(self.x), bool)
        for k in np.flatnonzero(grows):
            move = np.zeros(len(self.x))
            move[k] = self.size[k]
            try:
                moved_return = self(self.x + move)
                change = np.abs(moved_return - first - move)
            except ComputationError:  # (the plant falls: something depends on it)
                continue
            travels[k] = bool((change <= tolerance).all())
        turns = steady & (np.abs(advance) > self.size / 2)
        passed = np.where(travels | turns, advance, 0.0)
        self.shift = self.shift + passed
        self.travelling = tuple(
            name for name, x in zip(self.names, travels, strict=True) if x
        )
        if travels.all():
            raise DefinitionError(
                f"all coordinates of the plant travel ({listed(self.names)}), and nothing depends "
                "on them: there is no cycle whose multipliers could be estimated."
            )
        if not self.chosen:
            self._keep(np.flatnonzero(~travels))

    def _keep(self, rows: np.ndarray) -> None:
        """Keep only the coordinates `rows`."""
        self.names = tuple(self.names[k] for k in rows)
        self.columns = [self.columns[k] for k in rows]
        self.shift = self.shift[rows]
        self.x = self.x[rows]
        self.size = self.size[rows]
        self.noise = self.noise[rows]
        self.tolerance = self.tolerance[rows]

    def _noise(self) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """Return two standard deviations of returns from nearly equal states: at the narrowest
        spacing of states, and the largest at any spacing.

        They come from fourth differences along lines, whose variance is 70 times that of the noise
        (Moré and Wild 2011, Estimating computational noise). A narrow spacing shows rounding and
        tolerances; a wide one also shows events that move from one time step of the simulator to
        another.
        """
        magnitude = np.maximum(np.abs(self.x), self.size)
        rounding = np.finfo(float).eps * magnitude
        rng = np.random.default_rng(0)
        signs = rng.choice([-1, 1], (3, len(self.x)))
        spacings = [1e-6, 1e-4, 1e-3]
        levels = []
        for spacing, sign in zip(spacings, signs, strict=True):
            along = spacing * self.size * sign
            line = [self(self.x + j * along) for j in range(-7, 8)]
            differences = np.diff(line, 4, axis=0)
            variance = (differences**2 / 70).mean(axis=0)
            level = np.sqrt(variance)
            levels.append(np.maximum(level, rounding))
        narrowest = levels[0]
        largest = np.max(levels, axis=0)
        return narrowest, largest

    def slopes(self) -> Float[np.ndarray, "d d"]:
        """Return central differences of second order with the smallest steps."""
        columns = []
        for k in counted(range(len(self.x)), "coordinates", len(self.x)):
            columns.append(self._slope(k, 1.0, 0.0))
        return np.stack(columns, axis=1)

    def all_slopes(self) -> Float[np.ndarray, "pairs d d"]:
        """Return central differences with all steps, in units of the ranges of the coordinates.

        The grid is shifted from pair to pair. If contacts begin at the ends of time steps, the
        differences then scatter as they would over many stairs.
        """
        d = len(self.x)
        steps = np.tile(_STEPS, max(1, _COLUMNS // d))
        slopes = np.empty((len(steps), d, d))
        rng = np.random.default_rng(2)
        for k in counted(range(d), "coordinates", d):
            firsts = np.zeros(len(steps))
            if self.moves_grid:
                firsts = _grid_phases(rng, len(steps))
            for j, (step, first) in enumerate(zip(steps, firsts, strict=True)):
                slopes[j, :, k] = self._slope(k, step, first)
        return slopes * self.size / self.size[:, None]

    def _slope(self, k: int, step: float, first: float) -> Float[np.ndarray, " d"]:
        """Return the central difference of returns along coordinate k, with a step in units of the
        smallest one. `first`: length of the first time step, in units of the plant's steps."""
        move = np.zeros(len(self.x))
        move[k] = step * self.h[k]
        above = self(self.x + move, first=first)
        below = self(self.x - move, first=first)
        return (above - below) / (2 * move[k])

    def residual(self) -> Float[np.ndarray, " d"]:
        """Return the distance between return and state, in units of the ranges."""
        return (self(self.x) - self.x) / self.size

    def solve(self) -> Float[np.ndarray, " d"]:
        """Move x to the fixed point by Newton's method, as long as the residual falls, and return
        the residual. If the residual is only noise, x does not change."""
        residual = self.residual()
        for _ in range(8):
            allowed = 3 * self.noise / self.size
            if (np.abs(residual) <= allowed).all():
                break
            J = self.slopes() - np.eye(len(self.x))
            J = J * self.size / self.size[:, None]
            # (No step is taken along the direction of a multiplier of 1.)
            step = np.linalg.lstsq(J, residual, rcond=1e-6)[0]
            before = self.x
            self.x = before - self.size * step
            moved = self.residual()
            reached = np.abs(moved).max()
            if not reached < np.abs(residual).max():
                self.x = before
                break
            residual = moved
        return residual

    def require_on_cycle(self, residual: Float[np.ndarray, " d"]) -> None:
        """**Raises:** `ComputationError` for a state that is not on a cycle."""
        noise = self.noise / self.size
        visible = np.maximum(10 * noise, _RESIDUAL)
        beyond = np.abs(residual) / visible
        k = int(np.argmax(beyond))
        if beyond[k] <= 1:
            return
        raise ComputationError(
            f"the plant is not on its cycle: after one cycle `{self.names[k]}` differs by "
            f"{abs(residual[k]):.1g} of its range, and noise is {noise[k]:.1g}. Give `find_cycle` "
            "more `cycles`, or a `guess` nearer to the cycle."
        )


def _grid_phases(rng: np.random.Generator, count: int) -> Float[np.ndarray, " count"]:
    """Return shifts of the grid: one in each of `count` equal parts of a time step, in random
    order.

    A plant may divide its time steps. Shifts in a regular order could then be nearly equal, or be
    related to the sizes of the steps, and the scatter would be far too small.
    """
    return (rng.permutation(count) + rng.uniform(size=count)) / count


def measured_returns(map: ReturnMap) -> Returns:
    """Return the multipliers of a map after `ReturnMap.measure`.

    **Raises:** `ComputationError` for a state that is not on a cycle.
    """
    residual = map.solve()
    map.require_on_cycle(residual)
    resolved = _resolved(_slopes_of(map))
    longest = _MOST_OF_SMALLEST_STEP * map.size
    if _hides(resolved) and (map.h < longest).any():
        map.h = longest
        resolved = _resolved(_slopes_of(map))
    if _is_curved(resolved):
        map.h = map.h / _STEPS.max()
        closer = _resolved(_slopes_of(map))
        # (Shorter steps have more noise: they are taken only if no listed multiplier is hidden by
        # it.)
        if closer.bound < np.abs(resolved.multipliers).max():
            resolved = closer
        else:
            map.h = map.h * _STEPS.max()
    return Returns(
        resolved.multipliers,
        resolved.coefficients,
        resolved.covariance,
        resolved.dof,
        map.noise,
        map.names,
        float(np.abs(residual).max(initial=0)),
        resolved.bound,
        map.travelling,
        findings=tuple(_doubts(resolved, map)),
    )


def _slopes_of(map: ReturnMap) -> "_Jacobian":
    """Return the Jacobian of a map and its errors, in units of the ranges."""
    relative = map.size / map.size[:, None]
    tolerance = map.tolerance[:, None] / map.h * relative
    return _fitted(map.all_slopes(), tolerance)


def _hides(resolved: "_Resolved") -> bool:
    """Return whether a multiplier that is not listed may be the largest."""
    return resolved.bound > np.abs(resolved.multipliers).max(initial=_SMALL)


def _is_curved(resolved: "_Resolved") -> bool:
    """Return whether narrow and wide steps give clearly different multipliers."""
    moduli = np.abs(resolved.multipliers)
    allowed = _CURVED * moduli.max(initial=0)
    return bool((np.abs(resolved.apart) > allowed).any())


class _Jacobian(NamedTuple):
    """A Jacobian in units of the ranges of the coordinates, and its errors."""

    value: Float[np.ndarray, "d d"]
    errors: Float[np.ndarray, "pairs d d"]
    """Errors of `value`, by pair of perturbed states. If each column of each error is multiplied by
    a random number of variance 1, the sum over pairs has the covariance of the noise. (This keeps
    the correlation between outputs: a contact that begins one time step later changes all of
    them.)"""
    tolerance: Float[np.ndarray, "d d"]
    """Standard deviations of errors that all pairs may have in common, such as those by
    tolerances."""
    apart: Float[np.ndarray, "d d"]
    """Jacobian by narrow steps, less the Jacobian by wide steps."""
    apart_noise: float
    """Standard deviation of the noise of `apart`, in units of the noise of `value`."""


def _powers(steps: np.ndarray, count: int) -> np.ndarray:
    """Return even powers (n, count) of steps, the constant first."""
    return steps[:, None] ** (2.0 * np.arange(count))


def _solution(steps: np.ndarray, count: int) -> np.ndarray:
    """Return the matrix (count, n) from slopes to the coefficients of their weighted fit."""
    powers = _powers(steps, count)
    weighted = (powers * steps[:, None] ** 2).T
    return np.linalg.solve(weighted @ powers, weighted)


def _fitted(
    slopes: Float[np.ndarray, "pairs d d"], tolerance: Float[np.ndarray, "d d"]
) -> _Jacobian:
    """Fit slopes by J + c step^2. The noise is the scatter about a fit with one more power, so that
    curvature does not count as noise. `tolerance`: errors of the slopes by the tolerances of the
    plant."""
    repeats = len(slopes) // len(_STEPS)
    steps = np.tile(_STEPS, repeats)
    weights = steps**2
    coefficients = np.tensordot(_solution(steps, _POWERS_OF_SCATTER), slopes, (1, 0))
    fitted = np.tensordot(_powers(steps, _POWERS_OF_SCATTER), coefficients, (1, 0))
    residuals = slopes - fitted
    # (In units in which all have the same variance.)
    residuals = residuals * np.sqrt(weights)[:, None, None]
    # (The Jacobian is the constant J of a fit by J + c step^2.)
    constant = _solution(steps, 2)[0]
    variance = (constant**2 / weights).sum()
    between = np.zeros_like(steps)
    narrow = np.tile(_NARROW, repeats)
    wide = np.tile(_WIDE, repeats)
    between[narrow] += _solution(steps[narrow], 2)[0]
    between[wide] -= _solution(steps[wide], 2)[0]
    apart_variance = (between**2 / weights).sum()
    dof = len(steps) - _POWERS_OF_SCATTER
    return _Jacobian(
        value=np.tensordot(constant, slopes, (0, 0)),
        errors=np.sqrt(variance / dof) * residuals,
        tolerance=np.sqrt(variance / 2) * tolerance,
        apart=np.tensordot(between, slopes, (0, 0)),
        apart_noise=float(np.sqrt(apart_variance / variance)),
    )


class _Resolved(NamedTuple):
    """Multipliers that differ from 0."""

    multipliers: Complex[np.ndarray, " k"]
    coefficients: Float[np.ndarray, " k"]
    """Coefficients of the polynomial with these multipliers as roots."""
    covariance: Float[np.ndarray, "k k"]
    dof: float
    bound: float
    """Largest modulus that the other multipliers may have."""
    apart: Complex[np.ndarray, " k"]
    """Difference of each between narrow and wide steps; 0 if the difference may be noise."""


class _Eigenvalues(NamedTuple):
    """The eigenvalues of a Jacobian, and their errors.

    To first order, the error of an eigenvalue is w E v, with its eigenvectors w (left) and v and
    the error E of the Jacobian: a coordinate with large errors spoils only the eigenvalues that
    depend on it.
    """

    value: Complex[np.ndarray, " d"]
    left: Complex[np.ndarray, "d d"]
    """Left eigenvectors in columns. The product of each with its right eigenvector is 1."""
    right: Complex[np.ndarray, "d d"]
    variance: Float[np.ndarray, "d d"]
    """Variance of each eigenvalue (rows) that the noise of each column of the Jacobian causes."""
    apart: Complex[np.ndarray, " d"]
    """Difference of each between narrow and wide steps; 0 if the difference may be noise."""
    error: Float[np.ndarray, " d"]
    """Standard errors, with rounding and the bias of curvature."""


def _eigenvalues(jacobian: _Jacobian) -> _Eigenvalues:
    """Return the eigenvalues of a Jacobian with their errors."""
    from scipy import linalg  # (a fifth of a second)

    J = jacobian.value
    solution: Any = linalg.eig(J, left=True, right=True)
    values, left, right = solution
    product = np.einsum("ij,ij->j", left.conj(), right)
    # (The product is 0 for eigenvalues that coincide.)
    with np.errstate(all="ignore"):
        left = left / product.conj()
    rows = left.conj().T
    # (For each pair: the part of the error of eigenvalue i that comes from column k.)
    by_column = [(rows @ error) * right.T for error in jacobian.errors]
    noise = np.stack(by_column)
    variance = (np.abs(noise) ** 2).sum(axis=0)
    by_component = np.abs(rows) ** 2 @ jacobian.tolerance**2
    common = by_component @ np.abs(right) ** 2
    variances = variance.sum(axis=1) + np.diagonal(common)
    scatter = np.sqrt(variances)
    apart = np.diagonal(rows @ jacobian.apart @ right)
    is_noise = np.abs(apart) <= 2 * jacobian.apart_noise * scatter
    apart = np.where(is_noise, 0.0, apart)
    of_left = np.linalg.norm(left, axis=0)
    of_right = np.linalg.norm(right, axis=0)
    condition = of_left * of_right
    rounding = _ROUNDING * np.linalg.norm(J) * condition
    bias = _BIAS * np.abs(apart)
    error = np.hypot(scatter + rounding, bias)
    return _Eigenvalues(
        value=values,
        left=left,
        right=right,
        variance=variance,
        apart=apart,
        error=error,
    )


def _resolved(jacobian: _Jacobian) -> _Resolved:
    """Return the eigenvalues that differ from 0 by three standard errors, with the covariance of
    their polynomial by draws of the errors of the Jacobian."""
    found = _eigenvalues(jacobian)
    rows = _that_differ(found)
    J = jacobian.value
    pairs, d, _ = jacobian.errors.shape
    k = len(rows)
    rng = np.random.default_rng(0)
    draws = np.einsum(
        "bjk,jik->bik",
        rng.standard_normal((_DRAWS, pairs, d)),
        jacobian.errors,
    )
    draws += jacobian.tolerance * rng.standard_normal((_DRAWS, d, d))
    v = found.right[:, rows]
    w = found.left[:, rows].conj().T
    if k:
        # (The product is the identity, unless eigenvalues nearly coincide.)
        w = np.linalg.solve(w @ v, w)
    apart = found.apart[rows]
    random = rng.standard_normal((_DRAWS, 1, 1))
    biases = _BIAS * np.diag(apart) * random
    multipliers = found.value[rows]
    scattered = w @ draws @ v
    blocks = np.diag(multipliers) + scattered + biases
    drawn = [coefficients_of(np.linalg.eigvals(block)) for block in blocks]
    return _Resolved(
        multipliers=multipliers,
        coefficients=coefficients_of(multipliers),
        covariance=np.cov(drawn, rowvar=False).reshape(k, k),
        dof=_degrees(
            found.variance[rows], found.error[rows], pairs - _POWERS_OF_SCATTER
        ),
        bound=_bound(J + draws, v @ w) if k < d else 0.0,
        apart=apart,
    )


def _that_differ(found: _Eigenvalues) -> Int[np.ndarray, " k"]:
    """Return the indices of eigenvalues that differ from 0, the largest first. Of a conjugate pair,
    both or none are listed."""
    differs = np.abs(found.value) > _RESOLVED * found.error
    for i in np.flatnonzero(differs).tolist():
        differs[i] = differs[i] and differs[conjugate_of(found.value, i)]
    rows = np.flatnonzero(differs)
    return rows[largest_first(found.value[rows])]


def _bound(
    drawn: Float[np.ndarray, "draws d d"], projection: Complex[np.ndarray, "d d"]
) -> float:
    """Return a bound of the eigenvalues that are not listed: 97.5 % of draws have all their
    eigenvalues below it, after projection on the rest of the space."""
    rest = np.eye(len(projection)) - np.real(projection)
    others = np.linalg.eigvals(rest @ drawn @ rest)
    largest = np.abs(others).max(axis=1, initial=0)
    return float(np.quantile(largest, 0.975))


def _degrees(
    variance: Float[np.ndarray, "k d"], error: Float[np.ndarray, " k"], own: int
) -> float:
    """Return the smallest number of degrees of freedom of the errors (Satterthwaite 1946).

    **Arguments:** `variance`: variance of each multiplier by the noise of each column. `own`:
    degrees of freedom of the noise of one column.
    """
    degrees = [np.inf]
    for parts, total in zip(variance, error**2, strict=True):
        square = (parts**2).sum() / own
        if square > 0:
            degrees.append(total**2 / square)
    return float(min(degrees))


def _doubts(resolved: _Resolved, map: ReturnMap) -> list[Finding]:
    """Return findings about multipliers that noise hides, and about steps that disagree."""
    findings = []
    moduli = np.abs(resolved.multipliers)
    if _hides(resolved):
        findings.append(
            Finding(
                "hidden multipliers",
                f"noise of the returns may hide multipliers up to {resolved.bound:.2g}, so that "
                "one of those that are not listed may be the largest. Contacts that begin at the "
                "ends of time steps are such noise: take a shorter time step, or a contact force "
                "that begins at zero.",
            )
        )
    apart = np.abs(resolved.apart)
    relative = apart / np.maximum(moduli, _SMALL)
    k = int(np.argmax(relative)) if len(apart) else 0
    if len(apart) and relative[k] > _APART:
        step = float((map.h / map.size).max())
        findings.append(
            Finding(
                "amplitude",
                f"steps up to {2 * step:.1g} and {4 * step:.1g} of the ranges give moduli of "
                f"{moduli[k]:.3g} that differ by {apart[k]:.1g}: the plant is not linear there. "
                "Compare another time step, and multipliers at another section.",
            )
        )
    return findings
