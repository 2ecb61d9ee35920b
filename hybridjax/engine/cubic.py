"""Zero crossings of the cubic Hermite interpolant of a guard over one step.

`search/accept.py` calls `first_crossing` with the values and slopes of the guards at both ends of a
step, and gets the first crossing as a fraction of the step. The interpolant is cut at its extrema
into at most three monotone pieces, so that the first crossing is also found where the guard dips
below zero and returns within the step. `search/attempt.py` calls `bounds` to see that a guard stays
away from zero. An event that the search misses or invents has its cause in these two functions.
`dips` is the test of a trajectory that follows an itinerary. Slopes `d0` and `d1` must be per step
(a rate times the step's length), and a crossing is a zero at which the guard falls.
"""

from typing import NamedTuple

from jaxtyping import Bool, Float

from .._core.executor import namespace
from .arrays import Array


# An extremum within this part of the guard's values at the step's ends is a touch. Higher: passing
# near a guard is called grazing. Lower: grazing is missed.
TOUCH = 1e-10
# An extremum within this part of the guard's values at the step's ends is a near miss: the step is
# halved. Higher: more steps. Lower: a guard that dips below zero within a step is missed.
NEAR = 1e-2


# Points of a step at which the value of the cubic is compared with its error. Fewer: between two
# points, the guard may fall through zero although the cubic does not. More: time.
_POINTS = tuple(k / 8 for k in range(1, 8))


class CubicCrossing(NamedTuple):
    """Zeros and extrema of a guard within a step."""

    position: Float[Array, "*shape"]
    """The first falling zero, as a fraction of the step; infinity if there is none."""
    touch: Bool[Array, "*shape"]
    """The guard touches zero without a clear crossing."""
    near: Bool[Array, "*shape"]
    """Before the first crossing, the guard comes so close to zero that the interpolant cannot be
    trusted."""


Values = Float[Array, "*shape"]
Flags = Bool[Array, "*shape"]


def first_crossing(
    v0: Values,
    v1: Values,
    d0: Values,
    d1: Values,
    armed: Flags,
    margin: Values | float = 0.0,
    touching: Values | float = 0.0,
    turn: Values | float = 0.0,
) -> CubicCrossing:
    """First falling zero of the cubic with values v0, v1 and slopes d0, d1 (per step).

    A guard that is not armed at the start counts only after it has become positive. `margin` is the
    largest distance of the guard from the cubic halfway through the step. An extremum is a touch,
    too, if it lies within `touching` of zero, and if the guard changes by as much within `turn`
    steps from there.
    """
    xp = namespace(v1)
    cubic = _Cubic.of(v0, v1, d0, d1)
    sa, sb = cubic.extrema()
    va = xp.where(sa < 1, cubic.value(sa), v1)
    vb = xp.where(sb < 1, cubic.value(sb), v1)

    # The monotone piece that falls through zero first.
    first = armed & (va <= 0)
    second = (va > 0) & (vb <= 0) & (sb > sa)
    third = (vb > 0) & (v1 <= 0) & (sb < 1)
    begin_of_others = xp.where(second, sa, sb)
    end_of_others = xp.where(second, sb, 1.0)
    lo = xp.where(first, 0.0, begin_of_others)
    hi = xp.where(first, sa, end_of_others)
    crosses = first | second | third

    s = 0.5 * (lo + hi)
    for _ in range(10):  # Newton's steps within a bracket that shrinks, to rounding
        value = cubic.value(s)
        lo = xp.where(value > 0, s, lo)
        hi = xp.where(value > 0, hi, s)
        guess = s - _divide(value, cubic.slope(s))
        in_bracket = (guess >= lo) & (guess <= hi)
        s = xp.where(in_bracket, guess, 0.5 * (lo + hi))

    position = xp.where(crosses, s, xp.inf)
    scale = xp.maximum(xp.abs(v0), xp.abs(v1))
    small = TOUCH * scale
    touch = xp.zeros_like(armed)
    near = xp.zeros_like(armed)
    was_positive = armed & (v0 > 0)

    def touches(node, value):
        is_small = xp.abs(value) + _beside(node, margin) <= touching
        turns_soon = 2 * xp.abs(value) <= cubic.bend(node) * turn**2
        return is_small & turns_soon

    # An extremum at the end of the step itself.
    is_extremum = d1**2 <= 2 * cubic.bend(1.0) * touching
    touch = touch | (was_positive & is_extremum & touches(1.0, v1))
    for node, value, before in ((sa, va, was_positive), (sb, vb, va > 0)):
        is_minimum = cubic.b + 3 * cubic.c * node > 0
        dips = before & (node < 1) & is_minimum
        is_small = xp.abs(value) <= small
        sure = _beside(node, margin) <= small
        touch = touch | (dips & is_small & sure)
        touch = touch | (dips & touches(node, value))
        is_near = (value > small) & (value < NEAR * scale)
        near = near | (dips & is_near)
    # Before the first crossing, the guard may have another sign than the cubic.
    for node in (sa, sb, *_POINTS):
        unsure = xp.abs(cubic.value(node)) < _beside(node, margin)
        within = (node > 0) & (node < 1) & (node < position)
        near = near | (unsure & within)
    return CubicCrossing(position, touch, near)


class _Cubic(NamedTuple):
    """The cubic v0 + d0 s + b s^2 + c s^3 on [0, 1]."""

    v0: Values
    d0: Values
    b: Values
    c: Values

    @classmethod
    def of(cls, v0: Values, v1: Values, d0: Values, d1: Values) -> "_Cubic":
        """The cubic with values v0, v1 and slopes d0, d1 at the ends."""
        rise = v1 - v0
        b = 3 * rise - 2 * d0 - d1
        c = d0 + d1 - 2 * rise
        return cls(v0, d0, b, c)

    def value(self, s):
        quadratic = self.b + s * self.c
        return self.v0 + s * (self.d0 + s * quadratic)

    def slope(self, s):
        return self.d0 + s * (2 * self.b + s * 3 * self.c)

    def bend(self, s):
        """The second derivative."""
        return 2 * self.b + 6 * self.c * s

    def extrema(self) -> tuple[Array, Array]:
        """Positions of the two extrema within (0, 1), in order; 1 in place of an extremum outside
        of (0, 1).

        Extrema are the roots of d0 + 2 b s + 3 c s^2, computed without cancellation.
        """
        _, d0, b, c = self
        xp = namespace(b)
        disc = b * b - 3 * c * d0
        root = xp.sqrt(xp.maximum(disc, 0.0))
        sign = xp.where(b < 0, -1.0, 1.0)
        pivot = -(b + sign * root)
        r1 = _divide(pivot, 3 * c)
        r2 = _divide(d0, pivot)
        has_first = (disc > 0) & (r1 > 0) & (r1 < 1)
        has_second = (disc > 0) & (r2 > 0) & (r2 < 1)
        r1 = xp.where(has_first, r1, 1.0)
        r2 = xp.where(has_second, r2, 1.0)
        return xp.minimum(r1, r2), xp.maximum(r1, r2)


def _beside(s, margin):
    """The largest distance of a function from its cubic interpolant at s, if this distance is
    `margin` at s = 1/2. It is zero to second order at both ends."""
    return 16 * (s * (1 - s)) ** 2 * margin


def root_near_end(v0, v1, d0, d1) -> Float[Array, "*shape"]:
    """The zero of the cubic with values v0, v1 and slopes d0, d1 that Newton finds from s = 1."""
    cubic = _Cubic.of(v0, v1, d0, d1)
    s = namespace(v1).ones_like(v1)
    for _ in range(4):
        s = s - _divide(cubic.value(s), cubic.slope(s))
    return s


def dips(v0, v1, d0, d1) -> Flags:
    """Test whether the cubic with values v0, v1 and slopes d0, d1 (per step) is positive at both
    ends and negative between."""
    xp = namespace(v1)
    cubic = _Cubic.of(v0, v1, d0, d1)
    is_negative = xp.zeros_like(v1, bool)
    for node in cubic.extrema():
        is_negative = is_negative | ((node < 1) & (cubic.value(node) < 0))
    return (v0 > 0) & (v1 > 0) & is_negative


def bend_at_end(v0, v1, d0, d1) -> Float[Array, "*shape"]:
    """The second derivative, per step, of the cubic with values v0, v1 and slopes d0, d1 at its
    end."""
    return _Cubic.of(v0, v1, d0, d1).bend(1.0)


def interpolate(x, h, q0, q1, f0, f1):
    """The cubic at fraction x of a step of length h, from the states at its ends and the fields
    there, for arrays of either executor."""
    left = 1 - x
    by_first = q0 * (1 + 2 * x) * left**2
    by_last = q1 * x**2 * (3 - 2 * x)
    by_fields = h * x * left * (f0 * left - f1 * x)
    return by_first + by_last + by_fields


def halfway_cubic(q0, q1, f0, f1, h) -> tuple[Array, Array]:
    """The cubic and its rate halfway through a step of length h, from the states at its ends and
    the fields there."""
    xp = namespace(q1)
    mean_state = 0.5 * (q0 + q1)
    state = mean_state + 0.125 * h * (f0 - f1)
    length = xp.where(h == 0, 1.0, h)
    mean_rate = 1.5 * (q1 - q0) / length
    rate = mean_rate - 0.25 * (f0 + f1)
    return state, rate


def bounds(v0, v1, d0, d1, margin) -> tuple[Array, Array]:
    """Lower and upper bound of a function over a step, if its distance from its cubic interpolant
    halfway is at most `margin`.

    They are the extreme Bernstein coefficients of the two quartics that have this distance from the
    cubic halfway.
    """
    xp = namespace(v1)
    first = v0 + d0 / 4
    last = v1 - d1 / 4
    mean = 0.5 * (v0 + v1)
    middle = mean + (d0 - d1) / 6
    beside = 8 / 3 * margin
    low_begin = xp.minimum(v0, first)
    low_end = xp.minimum(last, v1)
    low = xp.minimum(low_begin, low_end)
    high_begin = xp.maximum(v0, first)
    high_end = xp.maximum(last, v1)
    high = xp.maximum(high_begin, high_end)
    return xp.minimum(low, middle - beside), xp.maximum(high, middle + beside)


def _divide(a, b):
    """Return a / b, and infinity where b is zero."""
    xp = namespace(b)
    divisor = xp.where(b == 0, 1.0, b)
    return xp.where(b == 0, xp.inf, a / divisor)
