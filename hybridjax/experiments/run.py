"""Batched experiments on a hybrid system around its limit cycle (paper Sec. V)."""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from tqdm import tqdm

from .._core.compile import quick_jit
from .._core.errors import ComputationError, DefinitionError
from .._core.precision import require_x64
from .._core.results import Result
from ..flow.move import Settings
from ..orbits.cycle import LimitCycle
from ..orbits.linearize import linearize
from ..orbits.place import PATIENCE, PlacedSections, as_placed
from ..orbits.plan import make_plan
from ..systems.output import Output
from ..systems.structure import Structure
from .data import ExperimentData
from .design import Design
from .respond import observe, respond


def run_experiments(
    cycle: LimitCycle,
    sections,
    design: Design | Float[np.ndarray, "S n nu"] | Float[Array, "S n nu"],
    outputs: Sequence[str | Output] | str | Output,
    *,
    start: str = "cycle",
    discard: int | None = None,
    periods: int | None = None,
    batch: int = 256,
    progress: bool = False,
    accuracy: float = 1e-9,
    scale: Mapping[str, float] | None = None,
) -> ExperimentData:
    """Excite the system around its limit cycle and record its outputs at the sections.

    All experiments of a batch run side by side in one compiled call. An experiment that fails
    (a section missed, events in another order, ...) stops there; the others go on.

    **Arguments:**

    - `sections`: a family, or `PlacedSections`.
    - `design`: a `Design`, or inputs (S, n, nu) that are held from section to section, with n a
        whole number of periods; then `periods` says how many of the last ones are for estimation
        (by default all that are not discarded).
    - `outputs`: names or `Output`s, recorded at each section before the new input acts.
    - `start`: "cycle" starts on the limit cycle, "periodic" in the periodic response that the
        linearisation predicts, so that there is almost no transient.
    - `discard`: cycles that come before the design's periods and are meant to be discarded. By
        default 20 from the cycle (the paper's) and 0 from the periodic start.
    - `batch`: experiments per compiled call; more need more memory.
    - `progress`: show a progress bar over the batches.
    - `accuracy`: bound on the error of the states (and on state-based sections, of the time) at
        every section, relative to `scale`. `data.error` is each experiment's own estimate.
    - `scale`: sizes of states by name (of time as `t`); by default the largest on the cycle.

    **Returns:** `ExperimentData`. `data.summary()` names what failed and why.

    **Raises:** `DefinitionError` for arguments that do not fit together; `ComputationError` for
    an unstable cycle, from which any experiment would run away.
    """
    placed = as_placed(cycle, sections)
    require_x64(cycle)
    system = cycle.system
    s = Structure(system)
    z = s.resolve_outputs(outputs)
    if not 1e-13 <= accuracy <= 1e-2:
        raise DefinitionError(f"accuracy lies between 1e-13 and 1e-2, not at {accuracy}.")
    if batch < 1:
        raise DefinitionError(f"batch is the number of experiments per call, not {batch}.")
    if start not in ("cycle", "periodic"):
        raise DefinitionError(f"start is 'cycle' or 'periodic', not {start!r}.")
    if not cycle.stable:
        largest = np.abs(cycle.multipliers[0])
        raise ComputationError(
            f"the limit cycle is not stable (largest multiplier {largest:.4g} in modulus), so "
            "experiments would leave it: stabilise the system, or use the exact linearisation "
            "(`linearize`), which needs no experiments."
        )
    u, periods = _inputs(design, placed.count, len(system.inputs), start, discard, periods)
    q = jnp.broadcast_to(_section_zero(placed), (1 + s.d, u.shape[0]))
    if start == "periodic":
        q = q + _periodic_start(cycle, placed, u, periods)
    size = min(batch, u.shape[0])
    scales = _scales(placed, scale)
    settings = Settings(rtol=accuracy, atol=accuracy * scales[:, 1:].min(), max_steps=PATIENCE)
    plan = make_plan(placed, settings, jnp.asarray(accuracy), jnp.asarray(scales))
    parts = []
    for k in tqdm(range(0, u.shape[0], size), disable=not progress, desc="experiments"):
        rows = np.arange(k, k + size) % u.shape[0]  # the last batch is filled up with repetitions
        part = _respond(placed, plan, q[:, rows], jnp.asarray(u[rows]), tuple(z.items), settings)
        keep = min(size, u.shape[0] - k)
        parts.append([np.asarray(x)[:keep] for x in part])
    y, result, failed_at, error = (np.concatenate(x) for x in zip(*parts, strict=True))
    base = np.asarray(_on_cycle(placed, tuple(z.items)))
    good = np.isfinite(y).all(axis=(1, 2)) | (result != Result.OK)
    if not good.all():
        for a in np.unique(placed.lanes.chart):
            z.require(int(a))
        raise DefinitionError(
            "an output is NaN although its experiment ran well: it is not defined everywhere that "
            "the experiments go."
        )
    return ExperimentData(
        u,
        y - np.tile(base, (u.shape[1] // placed.count, 1)),
        sections=placed.count,
        periods=periods,
        inputs=system.inputs,
        outputs=z.names,
        result=result,
        failed_at=failed_at,
        error=error,
        cycle_outputs=base,
        family=placed.sections.label,
    )


def _inputs(design, N: int, nu: int, start: str, discard, periods):
    """Inputs (S, n, nu) as numpy, and the number of periods for estimation."""
    discard = (20 if start == "cycle" else 0) if discard is None else discard
    if discard < 0 or discard != int(discard):
        raise DefinitionError(f"discard is the number of cycles before the window, not {discard}.")
    if isinstance(design, Design):
        if design.sections != N:
            raise DefinitionError(
                f"the design is for {design.sections} sections, but the family has {N}."
            )
        if len(design.input_names) != nu:
            raise DefinitionError(
                f"the design has {len(design.input_names)} inputs, but the system has {nu}."
            )
        if periods not in (None, design.periods):
            raise DefinitionError(
                f"`periods` is for inputs given as an array; the design has {design.periods}."
            )
        return design.inputs(discard + design.periods), design.periods
    if np.iscomplexobj(design):
        raise DefinitionError("inputs must be real; these are complex.")
    u = np.asarray(design, float)
    if u.ndim != 3 or u.shape[2] != nu or u.shape[1] % N or 0 in u.shape:
        raise DefinitionError(
            f"inputs must have the shape (experiments, samples, {nu}) with samples a multiple of "
            f"the {N} sections; got {u.shape}."
        )
    if not np.isfinite(u).all():
        worst = int(np.argwhere(~np.isfinite(u))[0, 0])
        raise DefinitionError(f"the input of experiment {worst} is NaN or infinite.")
    available = u.shape[1] // N - discard
    periods = available if periods is None else periods
    if not 1 <= periods <= available:
        raise DefinitionError(
            f"inputs of {u.shape[1] // N} cycles less {discard} discarded ones leave {available} "
            f"for estimation; got periods = {periods}."
        )
    return u, periods


def _section_zero(placed: PlacedSections) -> Float[Array, "n 1"]:
    lanes = placed.lanes
    return jnp.concatenate([lanes.t[None], lanes.q])[:, :1]


def _periodic_start(cycle, placed, u, periods) -> Float[np.ndarray, "n S"]:
    """Deviations of (t, q) at section 0 that begin the predicted periodic response."""
    if u.shape[1] // placed.count % periods:
        raise DefinitionError(
            "a periodic start needs inputs of a whole number of windows: use `discard=0`."
        )
    ldtp = linearize(cycle, placed, outputs=[Output("t", lambda t, q, u: t)])
    embed = np.asarray(placed.frames()[0][0])[:, : ldtp.A.shape[1]]
    window = u[:, : periods * placed.count]
    return embed @ np.stack([np.asarray(ldtp.periodic_state(w, periods)) for w in window], axis=1)


_respond = eqx.filter_jit(respond)


def _scales(placed: PlacedSections, scale: Mapping[str, float] | None) -> np.ndarray:
    """Scales (N, 1 + d) of time and states at the sections: the largest size on the cycle."""
    s = Structure(placed.cycle.system)
    chart, q = np.asarray(placed.lanes.chart), np.abs(np.asarray(placed.lanes.q))
    given = dict(scale or {})
    out = np.ones((placed.count, 1 + s.d))
    out[:, 0] = given.pop("t", float(placed.cycle.period))
    for name in s.state_names():
        places = [(a, c.states.index(name)) for a, c in enumerate(s.charts) if name in c.states]
        size = max((q[k, chart == a].max(initial=0.0) for a, k in places), default=0.0)
        size = given.pop(name, size if size > 0 else 1.0)
        for a, k in places:
            out[chart == a, 1 + k] = size
    if given or not np.all(out > 0) or not np.all(np.isfinite(out)):
        raise DefinitionError(
            "`scale` gives positive sizes of states, by name, and of time, as t; states are "
            f"{', '.join(s.state_names())}. Got {scale}."
        )
    return out


@quick_jit
def _on_cycle(placed: PlacedSections, outputs) -> Float[Array, "N ny"]:
    s = Structure(placed.cycle.system)
    u = jnp.zeros((s.nu, placed.count))
    return observe(s, s.resolve_outputs(outputs), placed.lanes, u).T
