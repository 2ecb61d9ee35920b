"""`HTF`: harmonic transfer functions on a grid of frequencies, exact or estimated.

`LDTP.htf`, `LimitCycle.htf` and `estimate_htf` make it; fits, designs and figures take it. Its
conventions are a contract with all of these: H_m stands at the *input* frequency, frequencies are
in cycles per period, and `variance` is E|dH|^2 of the complex error. Series, sums, inverses and
feedback connect HTFs as matrices (`algebra.py`), which needs all N harmonics. `VarianceDof` has the
accuracy of an estimated variance.

If the HTF of a loop is wrong, look at `algebra.py`; if its variance is, at `_variances` and
`algebra.variance_of`. If discs are too small or too large, look at `VarianceDof.quantile`; if a
prediction has a wrong frequency, at `HTF.predict`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Protocol, overload, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from .._core import limits
from .._core.arguments import Numbers, names, require_among, require_same
from .._core.boundary.checked import checked
from .._core.boundary.kinds import NewNames, Probability, SignalNames, Vector
from .._core.boundary.values import Complexes, Reals, Whole
from .._core.executor import from_host, is_traced, namespace, put, to_host
from .._core.html import COLORS, Curve, card, picture
from .._core.precision import require_x64
from .._core.showable import Showable
from .._core.signal import ratio, with_unit
from .._core.text import folded, how_many, listed
from ..errors import DefinitionError
from . import algebra
from .algebra import SAME_FREQUENCY
from .frequency_response import Harmonics, check_harmonics


_ENTRIES = "harmonics frequencies outputs inputs"


@checked
class VarianceDof(eqx.Module):
    r"""Degrees of freedom of an estimated `HTF.variance`, and shape of the sample that it was
    estimated from.

    **Arguments:**

    - `dof` (F,): complex degrees of freedom of the variance.
    - `roundness` (M, F, ny, nu): how round the sample is. It is $1 - |\sum_j d_j^2|^2 / (\sum_j
      |d_j|^2)^2$ of the residuals d of the realizations, relative to its mean for Gaussian errors:
      0 if all residuals lie on a line in the complex plane. None, or an array of ones: the shape is
      not used.
    - `shared`: whether errors at frequencies that differ by an integer stem from the same noise, as
      in a loop. Default: False, independent errors.

    **Raises:** `DefinitionError` for freedom that is not positive, or negative roundness.
    """

    dof: Float[Array, " F"]
    roundness: Float[Array, "M F ny nu"] | None
    shared: bool = eqx.field(static=True)

    def __init__(
        self,
        dof: Annotated[Numbers, Reals("frequencies", sign="positive")],
        roundness: Annotated[Numbers, Reals(_ENTRIES, sign="nonnegative")]
        | None = None,
        shared: bool = False,
    ):
        require_x64()
        self.shared = shared
        self.dof, self.roundness = from_host((dof, roundness))

    def sources(self, frequencies: Float[np.ndarray, " F"]) -> Int[np.ndarray, " F"]:
        """Return the index of the noise from which the errors of each line stem."""
        if not self.shared:
            return np.arange(len(frequencies))
        distance = np.minimum(frequencies % 1, -frequencies % 1)
        return np.unique(np.round(distance, 9), return_inverse=True)[1]

    def quantile(self, level: Probability) -> Float[Array, "*M F ny nu"]:
        r"""Quantile of $|\delta H|^2 / v$ at this probability.

        The quantile is $\nu (\alpha^{-1/\nu} - 1)$ (Fisher's $F_{2, 2\nu}$). If the roundness w is
        None, $\alpha = 1 - p$ for the level p, otherwise $\alpha = (1 - p)(1 + p^2 (w - 1))$: the
        flatter the sample, the larger the quantile. For Gaussian errors the shape of the sample is
        independent of its mean (Basu, Sankhya 1955). Therefore discs have the stated coverage for
        any w whose mean is one. Errors of equal moduli and random phases lie on a circle around
        zero. If the mean of a few of them is large, they lie on an arc, nearly on a line, and w is
        small.
        """
        dof, roundness = to_host((self.dof, self.roundness))
        dof = dof[:, None, None]
        xp = namespace(dof)
        excess = 0.0 if roundness is None else roundness - 1
        miss = (1 - level) * (1 + level**2 * excess)
        return from_host(dof * xp.expm1(-xp.log(miss) / dof))


Variance = Annotated[Numbers, Reals(_ENTRIES, sign="nonnegative", infinite=True)]

# Outputs, and harmonics (the largest ones), that a notebook shows. More: larger pages. Fewer: parts
# of the response are hidden.
_SHOWN = 4

# Part of the largest line of an input below which a line is rounding. Smaller: rounding counts as
# an input. Larger: weak lines are ignored.
_SILENT_LINE = 1e-10


@checked
class HTF(Showable, eqx.Module):
    r"""Harmonic transfer functions of a periodic system on a grid of input frequencies.

    An input $u[n] = e^{i w n}$ has the response

    $$y[n] = \sum_m H_m(w)\, e^{i (w + 2 \pi m / N) n}, \qquad w = 2 \pi f / N,$$

    so $H_m$ is **evaluated at the input frequency** and the output frequency is $f + m$ cycles per
    period. For real signals $H_{-m}(-w) = \overline{H_m(w)}$; $m$ counts modulo $N$.

    **Arguments:**

    - `frequencies` (F,): input frequencies, cycles per period.
    - `H` (M, F, ny, nu): complex values.
    - `harmonics` (M,): ascending integers, the `m` of `H`'s first axis.
    - `n_sections`: `N`, the number of sections (samples) in one period. It is 0 in continuous time,
        where n / N is time in periods and every integer m is a harmonic.
    - `inputs`, `outputs`: names, or units by name, as in `{"yM": "m"}`.
    - `source`: a label, "exact" or "estimate".
    - `variance` (M, F, ny, nu): E|dH|^2 of the complex error dH of estimates, which is circular
      (real and imaginary part each have half of it). It contains all random errors that the
      experiments reveal. None if it is unknown.
    - `noise_variance` (M, F, ny, nu): the part of `variance` that is noise, from repeated periods.
      The remainder is nonlinear distortion, which random phases make random. None if it is unknown.
    - `variance_dof`: degrees of freedom of `variance`; None if the variance is exact.
    - `power` (F, nu): excitation of each frequency, in any unit. Fits take errors as inversely
      proportional to it where `variance` is None. Default: the same for all.

    **Raises:** `DefinitionError` if these do not fit together.

    **Example:**

    ```python
    flat = hj.linear.HTF([0.1, 0.2], np.ones((1, 2, 1, 1)), harmonics=0, n_sections=8)
    print(flat)
    ```

    **After:** `hj.fit_multipliers`, `hj.fit_ldtp`, `hj.plot.bode`.
    """

    frequencies: Float[Array, " F"]
    H: Complex[Array, "M F ny nu"]
    variance: Float[Array, "M F ny nu"] | None
    noise_variance: Float[Array, "M F ny nu"] | None
    variance_dof: VarianceDof | None
    power: Float[Array, "F nu"] | None
    harmonics: tuple[int, ...] = eqx.field(static=True)
    n_sections: int = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    source: str = eqx.field(static=True)

    def __init__(
        self,
        frequencies: Vector,
        H: Annotated[Numbers, Complexes(_ENTRIES)],
        harmonics: Harmonics,
        n_sections: Annotated[int, Whole(0, limits.SECTIONS)],
        inputs: NewNames | None = None,
        outputs: NewNames | None = None,
        source: str = "estimate",
        *,
        variance: Variance | None = None,
        noise_variance: Variance | None = None,
        variance_dof: VarianceDof | None = None,
        power: Annotated[Numbers, Reals("frequencies inputs", sign="positive")]
        | None = None,
    ):
        require_x64()
        self.frequencies, self.H = from_host((frequencies, H.astype(complex)))
        self.harmonics = check_harmonics(harmonics, n_sections)
        shape = self.H.shape
        if shape[:2] != (len(self.harmonics), self.frequencies.shape[0]):
            raise DefinitionError(
                f"`H` has shape {shape}, but there are {len(self.harmonics)} harmonics and "
                f"{self.frequencies.shape[0]} frequencies (its first two axes)."
            )
        if not is_traced(frequencies):
            require_distinct(np.asarray(frequencies))
        if tuple(np.ravel(np.asarray(harmonics))) != self.harmonics:
            raise DefinitionError(f"`harmonics` must be ascending, but is {harmonics}.")
        self.n_sections = n_sections
        self.inputs = names("inputs", inputs, shape[3])
        self.outputs = names("outputs", outputs, shape[2])
        self.source = source
        self.variance = _optional("variance", variance, shape)
        self.noise_variance = _optional("noise_variance", noise_variance, shape)
        self.variance_dof = variance_dof
        self.power = _optional("power", power, (shape[1], shape[3]))
        if variance_dof is not None:
            _optional("variance_dof.dof", variance_dof.dof, self.frequencies.shape)
            _optional("variance_dof.roundness", variance_dof.roundness, shape)

    def __repr__(self) -> str:
        count = self.frequencies.shape[-1]
        counted = how_many(count, "frequency", "frequencies")
        span = ""
        if count and not is_traced(self.frequencies):
            f = np.asarray(self.frequencies)
            span = f" {f.min():.4g}"
            if count > 1:
                span = f" {f.min():.4g} to {f.max():.4g}"
        low = self.harmonics[0]
        high = self.harmonics[-1]
        shown = ", ".join(map(str, self.harmonics))
        if len(self.harmonics) == high - low + 1 > 3:
            shown = f"{low} to {high}"
        noun = "harmonic" if len(self.harmonics) == 1 else "harmonics"
        sections = "continuous time"
        if self.n_sections:
            sections = how_many(self.n_sections, "section", "sections")
        return folded(
            f"HTF({self.source}; {noun} {shown}; {counted}{span} cycles/period; "
            f"{sections}: {listed(self.inputs)} -> {listed(self.outputs)})"
        )

    def _repr_html_(self) -> str | None:
        """The first input's, as functions of frequency."""
        if is_traced(self) or self.H.ndim != 4 or not self.H.size:
            return None
        size = np.abs(np.asarray(self.H))[..., 0]
        u = self.inputs[0]
        f = np.asarray(self.frequencies)
        order = np.argsort(f)
        largest = np.argsort(-np.nanmax(size, axis=(1, 2)), kind="stable")[:_SHOWN]
        drawn = []
        for j, y in enumerate(self.outputs[:_SHOWN]):
            curves = []
            for color, k in zip(COLORS, np.sort(largest), strict=False):
                name = f"H_{self.harmonics[k]}"
                shown = size[k, order, j]
                curves.append(Curve(f[order], shown, name, color))
            axis = with_unit(f"|H|, {u} to {y}", ratio(y, u))
            drawn.append(picture(curves, "f (cycles/period)", axis, log=True))
        about = repr(self).partition(";")[2].removesuffix(")")
        return card("HTF", f"({self.source}):{about}", *drawn)

    @overload
    def __getitem__(self, m: int) -> Complex[Array, "F ny nu"]: ...
    @overload
    def __getitem__(self, m: str) -> "HTF": ...
    def __getitem__(self, m: int | str) -> Any:
        """`htf[0]` has the values of `H_0`, (F, ny, nu); `m` counts modulo `N`. `htf["yM"]` is the
        HTF of an output.

        **Raises:** `DefinitionError` if it is not among the harmonics or outputs stored.
        """
        if isinstance(m, str):
            return self.select(outputs=m)
        return from_host(to_host(self.H)[self._index(m)])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """`H`, for functions of NumPy."""
        return np.array(self.H, dtype) if copy else np.asarray(self.H, dtype)

    @property
    def magnitude(self) -> Float[Array, "M F ny nu"]:
        """|H|, in units of the output per unit of the input."""
        H = to_host(self.H)
        return from_host(namespace(H).abs(H))

    @property
    def phase(self) -> Float[Array, "M F ny nu"]:
        """The angle of H in radians, from -pi to pi: not unwrapped."""
        H = to_host(self.H)
        return from_host(namespace(H).angle(H))

    def select(
        self,
        harmonics: Harmonics | None = None,
        *,
        outputs: SignalNames | None = None,
        inputs: SignalNames | None = None,
    ) -> "HTF":
        """Return the HTFs of some harmonics, outputs and inputs, with their variances.

        **Arguments:** `harmonics`: one integer or several. `outputs`, `inputs`: names, in the order
        that is wanted. Default: all.

        **Raises:** `DefinitionError` for a harmonic, an output or an input that is not there.

        **Example:**

        ```python
        htf.select(0, outputs="yM").plot()
        ```
        """
        if harmonics is None:
            harmonics = self.harmonics
        harmonics = check_harmonics(harmonics, self.n_sections)
        rows = np.array([self._index(m) for m in harmonics])
        outputs, i = _chosen("output", outputs, self.outputs)
        inputs, j = _chosen("input", inputs, self.inputs)
        arrays = {
            "H": self.H,
            "variance": self.variance,
            "noise_variance": self.noise_variance,
        }
        if self.variance_dof is not None:
            arrays["roundness"] = self.variance_dof.roundness
        part = jax.tree.map(lambda x: x[rows][:, :, i][..., j], to_host(arrays))
        variance_dof = self.variance_dof
        if variance_dof is not None:
            variance_dof = replace(variance_dof, roundness=part.pop("roundness"))
        power = None if self.power is None else to_host(self.power)[:, j]
        return replace(
            self,
            harmonics=harmonics,
            outputs=outputs,
            inputs=inputs,
            variance_dof=variance_dof,
            power=power,
            **part,
        )

    def __matmul__(self, other: "HTF | HasHTF") -> "HTF":
        """This system after another, which acts first: the series `P @ Q`.

        HTFs are multiplied as harmonic matrices, see `feedback`.

        **Raises:** `DefinitionError` in the cases of `feedback`, and if the outputs of `other` are
        not the inputs of this system (by name and unit).
        """
        other = other if isinstance(other, HTF) else other.htf(self.frequencies)
        require_chain("@", other.outputs, self.inputs, self, other)
        return _combined(algebra.series, [self, other], other.inputs, self.outputs)

    def __add__(self, other: "HTF | HasHTF") -> "HTF":
        """The sum of the outputs of two systems with the same inputs.

        **Raises:** `DefinitionError` in the cases of `feedback`, and if inputs or outputs differ.
        """
        other = other if isinstance(other, HTF) else other.htf(self.frequencies)
        require_same("terms of a sum", self, other)
        return _combined(algebra.parallel, [self, other], self.inputs, self.outputs)

    def inverse(self) -> "HTF":
        """The HTFs from the outputs to the inputs.

        **Raises:** `DefinitionError` in the cases of `feedback`, and for different numbers of both.
        """
        if len(self.inputs) != len(self.outputs):
            raise DefinitionError(
                "an inverse needs as many inputs as outputs: leave some out."
            )
        return _combined(algebra.inverse, [self], self.outputs, self.inputs)

    def feedback(self, controller: "HTF | HasHTF") -> "HTF":
        r"""The loop of this system and a controller, $u = r - F y$: $(I + P F)^{-1} P$.

        HTFs are matrices at each class of lines f + integers, $H(f)[a, b] = H_{a-b}(f + b)$, since
        every input frequency of the class answers every other one. Variances are propagated to
        first order, from errors that are independent and circular. An operand without variances
        counts as exact if its source is "exact".

        **Arguments:** `controller`: HTFs with the same frequencies, or anything with a method
        `htf`: an `LDTP`, a fit.

        **Raises:** `DefinitionError` if not all N harmonics and all lines f + integers are there,
        or if names, units or frequencies do not fit.
        """
        other = (
            controller
            if isinstance(controller, HTF)
            else controller.htf(self.frequencies)
        )
        require_chain("feedback", self.outputs, other.inputs, self, other)
        require_chain("feedback", other.outputs, self.inputs, self, other)
        return _combined(algebra.feedback, [self, other], self.inputs, self.outputs)

    @property
    def standard_errors(self) -> Float[Array, "M F ny nu"] | None:
        """Root of the variance; None if it is unknown."""
        return None if self.variance is None else jnp.sqrt(self.variance)

    def confidence_radius(self, level: Probability = 0.95) -> Float[Array, "M F ny nu"]:
        r"""Radius of the disc around each estimate that holds the true value with this probability.

        $r^2 = v \ln(1 / (1 - level))$ for a variance $v$ that is known. If the variance was
        estimated from few experiments, discs are larger (`VarianceDof.quantile`). The probability
        is exact for complex Gaussian errors. With at least four realizations it is nearly exact for
        errors of equal moduli, such as the distortion by a single product of two cosines. The true
        value is the best linear approximation for inputs like those of the experiment, not the
        response to infinitely small inputs.

        **Raises:** `DefinitionError` without `variance`.
        """
        if self.variance is None:
            raise DefinitionError(
                "the HTFs have no variance: estimate them from several realizations of the "
                "design or from repeated periods."
            )
        quantile = (
            -np.log1p(-level)
            if self.variance_dof is None
            else self.variance_dof.quantile(level)
        )
        quantile, variance = to_host((quantile, self.variance))
        return from_host((quantile * variance) ** 0.5)

    def predict(
        self, u: Annotated[Numbers, Reals("samples inputs")]
    ) -> Float[Array, "time ny"]:
        """The periodic response to an input that repeats for ever.

        Harmonics that are not stored count as zero. Differentiable with respect to `H`.

        **Arguments:** `u` (n, nu), real, `n` a multiple of `N`, starting at section 0.

        **Returns:** (n, ny).

        **Raises:** `DefinitionError` if `n` is no multiple of `N`, if the harmonics are not
        symmetric about 0, or if `u` holds a frequency that is not on the grid (up to sign).
        """
        self.require_sampled("`predict`")
        N = self.n_sections
        n, nu = u.shape
        if n == 0 or n % N or nu != len(self.inputs):
            raise DefinitionError(
                f"`u` has shape {u.shape}, but needs a multiple of {N} samples and "
                f"{len(self.inputs)} columns."
            )
        periods = n // N
        U = np.fft.fft(np.asarray(u), axis=0)
        size = np.abs(U).max(axis=1)
        lines = np.flatnonzero(size > _SILENT_LINE * size.max())
        # A real system responds to -f with the conjugate of its response to f.
        f = np.concatenate([self.frequencies, -np.asarray(self.frequencies)])
        fractions = lines[:, None] / periods - f
        distance = np.abs(self._circle(fractions))
        lost = lines[distance.min(axis=1, initial=np.inf) > SAME_FREQUENCY]
        if len(lost):
            raise DefinitionError(
                f"`u` holds the frequency f = {abs(self._circle(lost[0] / periods)):g} "
                "cycles per period, at which there are no HTFs: compute or estimate them there."
            )
        H = to_host(self.H)
        xp = namespace(H)
        mirror = np.array([self._index(-m) for m in self.harmonics])
        both = xp.concatenate([H, H[mirror].conj()], axis=1)
        H = both[:, distance.argmin(axis=1)]
        parts = xp.einsum("mkij,kj->mki", H, U[lines])
        Y = xp.zeros((n, len(self.outputs)), complex)
        for m, part in zip(self.harmonics, parts, strict=True):
            at = (lines + periods * m) % n
            Y = put(Y, at, Y[at] + part)
        return from_host(xp.fft.ifft(Y, axis=0).real)

    def harmonic_errors(self, other: "HTF") -> Float[Array, "M ny"]:
        """Largest difference from `other` over frequencies and inputs, per harmonic and output.

        Relative to the largest modulus of `other`'s `H_0` of that output.

        **Raises:** `DefinitionError` if the two differ in frequencies, harmonics, sections, inputs
        or outputs, or have no `H_0`.
        """
        require_x64()
        fields = "n_sections", "harmonics", "inputs", "outputs"
        require_same("HTFs to be compared", self, other, fields)
        _require_same_lines(self, other)
        H, reference, zero = to_host((self.H, other.H, other[0]))
        difference = abs(H - reference).max((1, 3))
        return from_host(difference / abs(zero).max((0, 2)))

    def error(self, other: "HTF") -> Float[Array, " ny"]:
        """The largest of `harmonic_errors`, per output."""
        return from_host(to_host(self.harmonic_errors(other)).max(0))

    def require_sampled(self, name: str) -> None:
        """**Raises:** `DefinitionError` in continuous time."""
        if not self.n_sections:
            raise DefinitionError(
                f"{name} takes HTFs between sections, and these are of continuous time: make them "
                "by `linearize(cycle, sections).htf(f)`."
            )

    def _circle(self, f):
        """`f` modulo `N`, between `-N/2` and `N/2`; `f` itself in continuous time."""
        if not self.n_sections:
            return f
        return (f + self.n_sections / 2) % self.n_sections - self.n_sections / 2

    def _index(self, m):
        (m,) = check_harmonics(int(self._circle(m)), self.n_sections)
        if m not in self.harmonics:
            raise DefinitionError(
                f"harmonic {m} is not there; harmonics are {self.harmonics}."
            )
        return self.harmonics.index(m)


def _chosen(
    kind: str, wanted: Sequence[str] | None, names: tuple[str, ...]
) -> tuple[tuple[str, ...], Int[np.ndarray, " k"]]:
    """Return the signals of these names, with their units, and their indices."""
    if wanted is None:
        wanted = names
    require_among(kind, wanted, names)
    indices = [names.index(name) for name in wanted]
    return tuple(names[k] for k in indices), np.array(indices)


@runtime_checkable
class HasHTF(Protocol):
    """Anything with HTFs at all frequencies: `LDTP`, fits."""

    def htf(self, frequencies: Vector) -> HTF: ...


def require_chain(
    name: str, outputs: tuple[str, ...], inputs: tuple[str, ...], a, b
) -> None:
    """**Raises:** `DefinitionError` if outputs are not the inputs that they become, by name and
    unit, or two systems differ in their sections."""
    require_same("systems to be connected", a, b, ("n_sections",))
    if outputs != inputs:
        raise DefinitionError(
            f"{name}: the outputs {outputs} of one system are not the inputs {inputs} of the "
            "other: give them the same names and units (units are not converted)."
        )


def _require_same_lines(a: HTF, b: HTF) -> None:
    same = a.frequencies.shape == b.frequencies.shape
    if same and not is_traced(a.frequencies, b.frequencies):
        same = np.allclose(a.frequencies, b.frequencies, rtol=0, atol=SAME_FREQUENCY)
    if not same:
        raise DefinitionError(
            "two HTFs have different frequencies: compute both at the same `frequencies`."
        )


def _combined(
    operation: algebra.Operation,
    terms: list[HTF],
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
) -> HTF:
    """Return the result of an operation on harmonic matrices, with its variances."""
    first = terms[0]
    first.require_sampled("the algebra of HTFs")
    every = check_harmonics(None, first.n_sections)
    for term in terms:
        _require_same_lines(first, term)
        if term.harmonics != every:
            raise DefinitionError(
                f"algebra needs all {len(every)} harmonics: leave `harmonics` out."
            )
    lines = algebra.Lines.of(np.asarray(first.frequencies), first.n_sections)
    matrices = [lines.matrices(H) for H in to_host([term.H for term in terms])]
    result, pairs = operation(*matrices)

    def variance(name: str) -> Array | None:
        given = _variances(terms, name)
        if given is None:
            return None
        entries = [lines.matrices(values) for values in given]
        return lines.entries(algebra.variance_of(pairs, entries)).real

    exact = all(term.source == "exact" for term in terms)
    return HTF(
        first.frequencies,
        lines.entries(result),
        every,
        first.n_sections,
        inputs,
        outputs,
        "exact" if exact else "estimate",
        variance=variance("variance"),
        noise_variance=variance("noise_variance"),
        variance_dof=_least_scatter(terms, lines),
    )


def _variances(terms: list[HTF], name: str) -> list[Any] | None:
    """Return the variances of terms, zero for exact ones; None if all are exact, or one is not and
    has none."""
    given = to_host([getattr(term, name) for term in terms])
    out = []
    for term, values in zip(terms, given, strict=True):
        if values is None and term.source != "exact":
            return None
        out.append(np.zeros(term.H.shape) if values is None else values)
    return None if all(term.source == "exact" for term in terms) else out


def _least_scatter(terms: list[HTF], lines: algebra.Lines) -> VarianceDof | None:
    """Return the degrees of freedom of all lines of a class: the least of its lines and terms."""
    freedoms = to_host(
        [x.variance_dof.dof for x in terms if x.variance_dof is not None]
    )
    if not freedoms:
        return None
    xp = namespace(freedoms[0])
    by_line = xp.stack(freedoms).min(axis=0)
    by_class = by_line[lines.row].min(axis=1, keepdims=True)
    spread = put(xp.zeros(len(by_line)), lines.row, by_class)
    return VarianceDof(spread, shared=True)


def require_distinct(f: Float[np.ndarray, " F"]) -> None:
    """**Raises:** `DefinitionError` for a frequency that occurs twice."""
    f = np.sort(f)
    again = np.flatnonzero(np.diff(f) < SAME_FREQUENCY)
    if len(again):
        raise DefinitionError(
            f"`frequencies` holds {f[again[0]]:.10g} cycles per period twice: keep one."
        )


def _optional(name: str, value: Numbers | None, shape: tuple[int, ...]) -> Array | None:
    if value is None:
        return None
    array = jnp.asarray(value)
    if array.shape != shape:
        raise DefinitionError(
            f"`{name}` must have the shape {shape}, not {array.shape}."
        )
    return array
