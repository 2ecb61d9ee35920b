"""Harmonic transfer functions: exact or estimated, one container for both."""

from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from .._core.arguments import Numbers, names
from .._core.boundary.arrays import Complexes, Reals
from .._core.boundary.checked import checked
from .._core.boundary.kinds import NewNames, Probability, SectionCount, Vector
from .._core.executor import from_host
from .._core.html.responses import response_card
from .._core.precision import require_x64
from .._core.text import listed
from .._core.tracing import is_traced
from ..errors import DefinitionError
from .frequency_response import Frequencies, Harmonics, check_harmonics
from .realizations import Realizations


# Distance in cycles per period up to which two frequencies are the same. Doubled: lines of designs
# with periods beyond 5e8 are not told apart, instead of 1e9.
_SAME_FREQUENCY = 1e-9
# A gap between frequencies is interpolated if it is no wider than so many of the widest step
# (between frequencies that were measured). Doubled: errors of the spline in a gap grow 16 times.
_WIDEST_GAP = 2
Variance = Annotated[Numbers, Reals("M F ny nu", sign="nonnegative", infinite=True)]

# Part of the largest line of an input below which a line is rounding. Doubled: none but rounding.
_SILENT_LINE = 1e-10


@checked
class HTF(eqx.Module):
    r"""Harmonic transfer functions of a periodic system on a grid of input frequencies.

    An input $u[n] = e^{i w n}$ has the response

    $$y[n] = \sum_m H_m(w)\, e^{i (w + 2 \pi m / N) n}, \qquad w = 2 \pi f / N,$$

    so $H_m$ is **evaluated at the input frequency** and the output frequency is $f + m$ cycles per
    period. For real signals $H_{-m}(-w) = \overline{H_m(w)}$; $m$ counts modulo $N$.

    **Arguments:**

    - `f` (F,): input frequencies, cycles per period.
    - `H` (M, F, ny, nu): complex values.
    - `harmonics` (M,): ascending integers, the `m` of `H`'s first axis.
    - `n_sections`: `N`, the number of sections (samples) in one period.
    - `inputs`, `outputs`: names, or units by name, as in `{"yM": "m"}`.
    - `source`: a label, "exact" or "estimate".
    - `variance` (M, F, ny, nu): of estimates, E|dH|^2 of the complex error dH, which is circular
      (real and imaginary part each have half of it). Everything random that the experiments let
      be seen; None where they do not.
    - `noise_variance` (M, F, ny, nu): the part of it that is noise, from repeated periods. The
      rest is nonlinear distortion, which random phases make random. None where it was not split.
    - `variance_freedom` (F,): complex degrees of freedom of `variance`; None where it is known
      exactly.
    - `realizations`: what each experiment tells, where there are few; None where that is not kept.

    **Raises:** `DefinitionError` if these do not fit together.
    """

    f: Float[Array, " F"]
    H: Complex[Array, "M F ny nu"]
    variance: Float[Array, "M F ny nu"] | None
    noise_variance: Float[Array, "M F ny nu"] | None
    variance_freedom: Float[Array, " F"] | None
    realizations: Realizations | None
    harmonics: tuple[int, ...] = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    source: str = eqx.field(static=True)

    def __init__(
        self,
        f: Vector,
        H: Annotated[Numbers, Complexes("M F ny nu")],
        harmonics: Harmonics,
        n_sections: SectionCount,
        inputs: NewNames | None = None,
        outputs: NewNames | None = None,
        source: str = "estimate",
        *,
        variance: Variance | None = None,
        noise_variance: Variance | None = None,
        variance_freedom: Annotated[Numbers, Reals("F", sign="positive")] | None = None,
        realizations: Realizations | None = None,
    ):
        require_x64()
        self.f, self.H = from_host((f, H.astype(complex)))
        self.harmonics = check_harmonics(harmonics, n_sections)
        shape = self.H.shape
        if shape[:2] != (len(self.harmonics), self.f.shape[0]):
            raise DefinitionError(
                f"`H` has shape {shape}, but there are {len(self.harmonics)} harmonics and "
                f"{self.f.shape[0]} frequencies (its first two axes)."
            )
        if tuple(np.atleast_1d(harmonics)) != self.harmonics:
            raise DefinitionError(f"`harmonics` must be ascending, but is {harmonics}.")
        self.n_sections = n_sections
        self.outputs = names("outputs", outputs, shape[2])
        self.inputs = names("inputs", inputs, shape[3])
        self.source = source
        self.variance = _optional("variance", variance, shape)
        self.noise_variance = _optional("noise_variance", noise_variance, shape)
        self.variance_freedom = _optional("variance_freedom", variance_freedom, self.f.shape)
        _optional("realizations", realizations and realizations.parts[0], shape)
        self.realizations = realizations

    def __repr__(self) -> str:
        count = self.f.shape[-1]
        span = ""
        if count and not is_traced(self.f):
            f = np.asarray(self.f)
            span = f" {f.min():.4g} to {f.max():.4g}"
        low, high, number = self.harmonics[0], self.harmonics[-1], len(self.harmonics)
        dense = number == high - low + 1
        shown = f"{low} to {high}" if dense and number > 3 else ", ".join(map(str, self.harmonics))
        return (
            f"HTF({self.source}; harmonics {shown}; {count} frequencies{span} cycles/period; "
            f"{self.n_sections} sections: {listed(self.inputs)} -> {listed(self.outputs)})"
        )

    def _repr_html_(self) -> str | None:
        """The first input's, as functions of frequency."""
        if is_traced(self) or self.H.ndim != 4 or not self.H.size:
            return None
        f, H, of = np.asarray(self.f), np.abs(np.asarray(self.H))[..., 0], repr(self)
        return response_card(f, H, self.harmonics, self.inputs[0], self.outputs, of)

    def harmonic(self, m: int) -> Complex[Array, "F ny nu"]:
        """`H_m`; `m` counts modulo `N`.

        **Raises:** `DefinitionError` if it is not among the harmonics stored.
        """
        return self.H[self._index(m)]

    def __getitem__(self, m: int) -> Complex[Array, "F ny nu"]:
        return self.harmonic(m)

    def select(self, harmonics: Harmonics) -> "HTF":
        """The same with fewer harmonics."""
        harmonics = check_harmonics(harmonics, self.n_sections)
        rows = np.array([self._index(m) for m in harmonics])
        variance, noise = (None if v is None else v[rows] for v in self._variances)
        single = self.realizations and self.realizations.select(rows)
        return self._with(
            self.f, self.H[rows], harmonics, variance, noise, self.variance_freedom, single
        )

    def at(self, f: Frequencies) -> "HTF":
        """The same at fewer frequencies (F,), in this order (host side).

        **Raises:** `DefinitionError` for a frequency that was not measured.
        """
        if is_traced(self.f, f):
            raise DefinitionError("`at` must know `f`: call it outside of jit.")
        wanted, known = np.atleast_1d(np.asarray(f, float)), np.asarray(self.f)
        distance = np.abs(known - wanted[:, None])
        nearest = np.argmin(distance, axis=1)
        lost = ~(distance.min(axis=1) < _SAME_FREQUENCY)
        if lost.any():
            raise DefinitionError(
                f"f = {wanted[lost][0]:.10g} was not excited or not measured; the nearest one is "
                f"{known[nearest[lost][0]]:.10g} (`interpolate` goes between them)."
            )
        variance, noise = (None if v is None else v[:, nearest] for v in self._variances)
        known_by = self.variance_freedom
        freedom = None if known_by is None else known_by[nearest]
        single = self.realizations and self.realizations.at(nearest)
        return self._with(
            self.f[nearest], self.H[:, nearest], self.harmonics, variance, noise, freedom, single
        )

    def confidence_radius(self, level: Probability = 0.95) -> Float[Array, "M F ny nu"]:
        r"""Radius of the disc around each estimate that holds the true value with this probability.

        $r^2 = v\, F_{2, 2\nu}(level) = v\, \nu\, ((1 - level)^{-1/\nu} - 1)$ for the variance $v$
        with $\nu$ complex degrees of freedom: the error is complex normal, and $v$ was estimated
        from few experiments. The true value is the best linear approximation for inputs of the
        kind that was applied, not the response to infinitely small ones.

        **Raises:** `DefinitionError` without `variance`.
        """
        if self.variance is None:
            raise DefinitionError(
                "the HTFs have no variance: estimate them from several realizations of the "
                "design or from repeated periods."
            )
        if self.variance_freedom is None:
            return jnp.sqrt(-np.log1p(-level) * self.variance)
        freedom = self.variance_freedom
        quantile = freedom * jnp.expm1(-np.log1p(-level) / freedom)
        return jnp.sqrt(quantile[:, None, None] * self.variance)

    def contains(self, true: "HTF", level: Probability = 0.95) -> Bool[np.ndarray, "M F ny nu"]:
        """Whether confidence regions of this level hold supposed values (host side).

        The region of an estimate from 2 to 16 realizations is the set of the values that their
        errors do not speak against, whatever the distribution of these (`Realizations.p_values`);
        of two it is wide. Elsewhere it is the disc of `confidence_radius`, which counts on normal
        errors: a little too small for distortion of a few products of cosines.

        **Raises:** `DefinitionError` if the two do not fit together, or without `variance`.
        """
        if is_traced(self.H, true.H):
            raise DefinitionError("`contains` works on the host, not inside jit or derivatives.")
        self._require_alike(true)
        radius = np.asarray(self.confidence_radius(level))
        if self.realizations is None:
            return np.abs(np.asarray(self.H) - np.asarray(true.H)) <= radius
        return self.realizations.p_values(np.asarray(true.H)) > 1 - level

    def interpolate(self, f: Frequencies) -> "HTF":
        """The HTFs at other frequencies, by cubic splines between neighbors (host side).

        If the harmonics are symmetric about 0, the symmetry for real signals adds the negative
        frequencies as neighbors, so that `f = 0` and `f = N/2` can be had too.

        **Arguments:** `f` (F,), cycles per period.

        Variances are interpolated linearly, which is on the safe side: a spline averages.

        **Raises:** `DefinitionError` if a frequency lies in a gap more than twice as wide as the
        widest step between the frequencies given (or outside them all).
        """
        from scipy.interpolate import CubicSpline, make_interp_spline  # (a quarter of a second)

        if is_traced(self.f, self.H, f):
            raise DefinitionError("`interpolate` works on the host, not inside jit or derivatives.")
        wanted = np.atleast_1d(f)
        knots, values = self._neighbors(self.H)
        given = np.unique(self.f)
        if len(given) < 2:
            raise DefinitionError("Interpolation needs at least two frequencies.")
        step = np.diff(given)
        ends = (
            np.flatnonzero(
                np.diff(knots) > _WIDEST_GAP * step[step > _SAME_FREQUENCY].max() + _SAME_FREQUENCY
            )
            + 1
        )
        place = np.mod(wanted, self.n_sections)
        H = np.full((values.shape[0], len(wanted), *values.shape[2:]), np.nan, complex)
        for run in np.split(np.arange(len(knots)), ends):
            inside = (place >= knots[run[0]] - _SAME_FREQUENCY) & (
                place <= knots[run[-1]] + _SAME_FREQUENCY
            )
            if len(run) > 1 and np.any(inside):
                H[:, inside] = CubicSpline(knots[run], values[:, run], axis=1)(place[inside])
        missing = np.isnan(H[0, :, 0, 0])
        if np.any(missing):
            raise DefinitionError(
                f"f = {wanted[missing][0]:g} cycles per period is too far from the frequencies "
                f"measured ({given[0]:g} to {given[-1]:g}) to interpolate."
            )

        def linear(values):
            if values is None:
                return None
            line = make_interp_spline(*self._neighbors(values), k=1, axis=1)
            return line(place)

        freedom = self.variance_freedom
        if freedom is not None:
            freedom = linear(freedom[None, :, None, None] + 0 * self.H.real)[0, :, 0, 0]
        variance, noise = map(linear, self._variances)
        return self._with(wanted, H, self.harmonics, variance, noise, freedom)

    def predict(self, u: Annotated[Numbers, Reals("n nu")]) -> Float[Array, "time ny"]:
        """The periodic response to an input that repeats for ever.

        Harmonics that are not stored count as zero. Differentiable with respect to `H`.

        **Arguments:** `u` (n, nu), real, `n` a multiple of `N`, starting at section 0.

        **Returns:** (n, ny).

        **Raises:** `DefinitionError` if `n` is no multiple of `N`, if the harmonics are not
        symmetric about 0, or if `u` holds a frequency that is not on the grid `f` (up to sign).
        """
        if is_traced(self.f, u):
            raise DefinitionError("`predict` must know `u` and `f`: call it outside of jit.")
        values = np.asarray(u)
        n, nu = values.shape
        if n == 0 or n % self.n_sections or nu != len(self.inputs):
            raise DefinitionError(
                f"`u` has shape {values.shape}, but needs a multiple of {self.n_sections} samples "
                f"and {len(self.inputs)} columns."
            )
        mirror = self._mirror()
        if mirror is None:
            raise DefinitionError(
                f"A real response needs harmonics symmetric about 0, not {self.harmonics}."
            )
        periods = n // self.n_sections
        U = np.fft.fft(values, axis=0)
        excited = np.flatnonzero(np.abs(U).max(axis=1) > _SILENT_LINE * np.abs(U).max())
        lines, conjugate, here = [], [], []
        for k in excited:
            for sign in (1, -1):
                distance = np.abs(self._circle(np.asarray(self.f) - sign * k / periods))
                if len(distance) and distance.min() < _SAME_FREQUENCY:
                    lines.append(k)
                    conjugate.append(sign < 0)
                    here.append(int(np.argmin(distance)))
                    break
            else:
                raise DefinitionError(
                    f"`u` holds the frequency f = {abs(self._circle(k / periods)):g} cycles per "
                    "period, where the HTFs are not known."
                )
        lines, here = np.array(lines, int), np.array(here, int)
        conjugate = np.array(conjugate, bool)[:, None, None]
        H = jnp.where(conjugate, jnp.conj(self.H[np.array(mirror)][:, here]), self.H[:, here])
        parts = jnp.einsum("mkij,kj->mki", H, U[lines])
        places = (lines + periods * np.array(self.harmonics)[:, None]) % n
        Y = jnp.zeros((n, len(self.outputs)), complex).at[places].add(parts)
        return jnp.fft.ifft(Y, axis=0).real

    def harmonic_errors(self, other: "HTF") -> Float[Array, "M ny"]:
        """Largest difference from `other` over frequencies and inputs, per harmonic and output.

        Relative to the largest modulus of `other`'s `H_0` of that output.

        **Raises:** `DefinitionError` if the two differ in frequencies, harmonics, sections, inputs
        or outputs, or have no `H_0`.
        """
        require_x64()
        self._require_alike(other)
        scale = jnp.max(jnp.abs(other.harmonic(0)), axis=(0, 2))
        return jnp.max(jnp.abs(self.H - other.H), axis=(1, 3)) / scale

    def error(self, other: "HTF") -> Float[Array, " ny"]:
        """The largest of `harmonic_errors`, per output."""
        return jnp.max(self.harmonic_errors(other), axis=0)

    def _require_alike(self, other: "HTF") -> None:
        for name in ("n_sections", "harmonics", "inputs", "outputs"):
            mine, its = getattr(self, name), getattr(other, name)
            if mine != its:
                raise DefinitionError(
                    f"Two HTFs with different {name} cannot be compared: {mine} and {its}."
                )
        if self.f.shape != other.f.shape or not (
            is_traced(self.f, other.f) or np.allclose(self.f, other.f, rtol=0, atol=_SAME_FREQUENCY)
        ):
            raise DefinitionError("Two HTFs at different frequencies cannot be compared.")

    @property
    def _variances(self):
        return self.variance, self.noise_variance

    def _with(self, f, H, harmonics, variance, noise_variance, freedom, realizations=None):
        return HTF(
            f, H, harmonics, self.n_sections, self.inputs, self.outputs, self.source,
            variance=variance, noise_variance=noise_variance, variance_freedom=freedom,
            realizations=realizations,
        )  # fmt: skip

    def _circle(self, f):
        """`f` modulo `N`, between `-N/2` and `N/2`."""
        return (f + self.n_sections / 2) % self.n_sections - self.n_sections / 2

    def _index(self, m):
        (m,) = check_harmonics(int(self._circle(m)), self.n_sections)
        if m not in self.harmonics:
            raise DefinitionError(f"Harmonic {m} is not stored; those are {self.harmonics}.")
        return self.harmonics.index(m)

    def _mirror(self):
        """For each harmonic the index of its negative, or `None` if one is not stored."""
        known = {m % self.n_sections: row for row, m in enumerate(self.harmonics)}
        mirror = [known.get(-m % self.n_sections) for m in self.harmonics]
        return None if None in mirror else mirror

    def _neighbors(self, values):
        """Distinct frequencies on three turns of the circle of length `N`, and values there."""
        f, H = np.asarray(self.f), np.asarray(values)
        mirror = self._mirror()
        if mirror is not None:
            f, H = np.concatenate([f, -f]), np.concatenate([H, H[mirror].conj()], axis=1)
        f = np.mod(f, self.n_sections)
        f[self.n_sections - f < _SAME_FREQUENCY] = 0.0
        order = np.argsort(f, kind="stable")
        order = order[np.diff(f[order], prepend=-1.0) > _SAME_FREQUENCY]
        f, H = f[order], H[:, order]
        turns = np.concatenate([f - self.n_sections, f, f + self.n_sections])
        return turns, np.tile(H, (1, 3, 1, 1))


def _optional(name: str, value: Numbers | None, shape: tuple[int, ...]) -> Array | None:
    if value is None:
        return None
    array = jnp.asarray(value)
    if array.shape != shape:
        raise DefinitionError(f"`{name}` must have the shape {shape}, not {array.shape}.")
    return array
