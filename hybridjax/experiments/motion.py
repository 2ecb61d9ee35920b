"""The whole motion of a single experiment, between sections, too.

`perturbed_trajectory` is for animations and figures (`plot/motion.py` calls it): data of
experiments have the sections only. It moves one lane from section to section, as `response.py`
does, and keeps the recorded steps (`tape`). Times and events are counted within one turn, as there;
`shift` turns them into times of the whole motion. It must grow only after the steps to section 0
are stored: these begin in the turn before.

If times jump at section 0, look at `shift`; if the motion differs from the data, look at the start,
which is on the cycle here.
"""

from typing import Annotated

import jax
import numpy as np

from .._core.boundary.checked import checked
from .._core.boundary.kinds import Numbers
from .._core.boundary.values import Reals
from .._core.compilation import at_ease
from .._core.executor import to_host
from .._core.precision import require_x64
from .._core.results import Result
from ..engine.lanes import Tape
from ..engine.move import Options, move
from ..engine.trajectory import Trajectory, recorded
from ..errors import ComputationError
from ..sections.placed import PlacedSections
from .response import require_shape


@checked
def perturbed_trajectory(
    placed: PlacedSections, inputs: Annotated[Numbers, Reals("samples inputs")]
) -> Trajectory:
    """Return the motion from section 0 of the cycle under inputs that are held from section to
    section, for `hj.plot.animate` and `hj.plot.cycle`.

    **Arguments:**

    - `placed`: the sections of the experiments.
    - `inputs` (n, nu), in whole periods, such as `data.u[0]`. (An experiment that did not start on
        the cycle differs until its transient has decayed.)

    **Returns:** a `Trajectory` of n / N periods.

    **Raises:** `DefinitionError` for inputs of another shape; `ComputationError` if a section is
    not reached.

    **Example:**

    ```python
    placed = hj.sections.place_sections(cycle, sections)
    motion = hj.experiments.perturbed_trajectory(placed, data.u[0, :16])
    hj.plot.cycle(cycle, perturbed=motion)
    ```

    **Before:** `hj.sections.place_sections`, `hj.run_experiments`. **After:** `hj.plot.animate`,
    `hj.plot.cycle`.
    """
    require_x64()
    held: np.ndarray = np.asarray(inputs)
    s = placed.structure()
    N = placed.n_sections
    placed = to_host(placed)
    require_shape((1, *held.shape), N, s.nu)
    lanes = jax.tree_util.tree_map(lambda x: x[..., :1], placed.lanes)
    period = float(placed.cycle.period)
    turn = len(placed.cycle.event_sequence)
    settings = placed.cycle.settings
    tapes = list[Tape]()
    shift = 0.0
    begin = lanes
    for k, u in enumerate(held[..., None]):
        j = (k + 1) % N
        turns = int(j == 0)
        target = placed.target(np.array([j]), lanes.t, np.array([turns]))
        with at_ease():
            moved, tape = move(
                s, lanes, u, target, settings, options=Options(tape=True)
            )
        assert tape is not None
        result = Result(int(moved.result[0]))
        if result != Result.OK:
            raise ComputationError(
                f"the motion stops after sample {k}: {result.message}."
            )
        tapes.append(tape._replace(t=tape.t + shift))
        shift += turns * period
        lanes = moved.lanes._replace(
            t=moved.lanes.t - turns * period, events=moved.lanes.events - turns * turn
        )
    return recorded(s, begin, tapes, held.T, Result.OK)
