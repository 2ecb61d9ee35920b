"""What goes wrong in laboratories, by name."""

from collections.abc import Callable
from functools import partial

import numpy as np

from ..._core.boundary.checked import checked
from ..._core.boundary.kinds import Seed, SignalNames
from ...errors import DefinitionError
from ...recordings.recording import Recording
from .change import Names
from .clocks import (
    clock_of_push,
    clock_set,
    jitter,
    late_push,
    misjudged_events,
    other_event,
    other_unit,
    pause,
    slow_sampling,
    slowing,
    thinning,
)
from .samples import (
    clipping,
    crosstalk,
    drift,
    freezing,
    gap,
    hidden_events,
    hum,
    loss,
    low_pass,
    noise,
    overflow,
    placeholder,
    rounding,
    saturation,
    spikes,
    wander,
)
from .trials import (
    doubled_column,
    foreign_push,
    late_switch,
    no_plug,
    other_setting,
    overlap,
    slipping,
    swapped_columns,
    thrice,
    unrelated_push,
)


Mishap = Callable[[Recording, Names, np.random.Generator], Recording]

MISHAPS: dict[str, Mishap] = {
    # sensors, amplifiers, converters
    "white noise": partial(noise, size=0.01),
    "rounded to 12 bits": partial(rounding, bits=12),
    "slow drift": partial(drift, size=0.1),
    "the zero wanders": partial(wander, size=0.1),
    "hum of the mains": partial(hum, frequency=50.2, size=0.02),
    "push leaks into outputs": partial(crosstalk, size=0.01),
    "slow sensors": partial(low_pass, edge=8.0),
    "sensor saturates softly": partial(saturation, size=0.5),
    "clipped at the top": partial(clipping, of="output", low=0.0, high=0.95),
    "clipped at both ends": partial(clipping, of="output", low=0.1, high=0.9),
    "push clipped": partial(clipping, of="input", low=0.05, high=0.95),
    "integers overflow": partial(overflow, bits=12, share=0.8),
    # missing and wrong samples
    "1 % of the samples lost": partial(loss, share=0.01),
    "gap of five cycles": partial(gap, of="outputs", cycles=5.3),
    "gap of the push": partial(gap, of="input", cycles=2.3),
    "gaps over the crossing": partial(hidden_events, number=5, cycles=0.15),
    "0.1 % spikes": partial(spikes, of="outputs", share=0.001, size=20.0),
    "1 % spikes": partial(spikes, of="outputs", share=0.01, size=20.0),
    "0.1 % spikes of the push": partial(spikes, of="input", share=0.001, size=20.0),
    "-9999 for no value": partial(placeholder, value=-9999.0, number=5, cycles=0.2),
    "0 for no value": partial(placeholder, value=0.0, number=5, cycles=0.7),
    "output frozen for a while": partial(freezing, of="outputs", share=0.2),
    "output frozen": partial(freezing, of="outputs", share=1.0),
    "push frozen for a while": partial(freezing, of="input", share=0.2),
    # cables, settings, files
    "millimeters in one trial": partial(other_setting, of="output", gain=1000.0),
    "kilonewtons in one trial": partial(other_setting, of="input", gain=0.001),
    "sign of an output in one trial": partial(other_setting, of="output", gain=-1.0),
    "sign of the push in one trial": partial(other_setting, of="input", gain=-1.0),
    "other gain in one trial": partial(other_setting, of="output", gain=1.1),
    "other zero in one trial": partial(other_setting, of="output", offset=0.5),
    "sensor slips in one trial": partial(slipping, size=0.3),
    "columns swapped in one trial": swapped_columns,
    "an output twice": doubled_column,
    "push of another trial": foreign_push,
    "push unrelated in all": unrelated_push,
    "push switched on late": partial(late_switch, cycles=10.0),
    "push not plugged in": no_plug,
    "the same trial thrice": thrice,
    "overlapping trials": overlap,
    # clocks
    "a third of the samples not there": partial(thinning, share=1 / 3),
    "few samples": partial(slow_sampling, every=8),
    "jitter of the time stamps": partial(jitter, share=0.05),
    "a pause": partial(pause, cycles=4.4),
    "clock slows down": partial(slowing, share=0.05),
    "clock set forward": partial(clock_set, cycles=0.3),
    "clock set back": partial(clock_set, cycles=-0.3),
    "milliseconds in one trial": partial(other_unit, factor=1000.0),
    "slow clock in one trial": partial(other_unit, factor=1.1),
    "push late": partial(late_push, samples=10),
    "push early": partial(late_push, samples=-10),
    "push late in one trial": partial(late_push, samples=25, only=(1,)),
    "clock of the push is fast": partial(clock_of_push, share=0.005),
}
"""What may happen to a recording, by name; sizes are in standard deviations of each signal."""

EVENT_MISHAPS: dict[str, Mishap] = {
    "events lost and doubled": partial(misjudged_events, lost=0.05, doubled=0.05),
    "events inexact": partial(misjudged_events, off=0.0005),
    "another event in one trial": partial(other_event, cycles=0.4),
}
"""What may happen to recorded events, by name."""


@checked
def mishandle(
    recording: Recording,
    mishap: str,
    *,
    input: str,
    outputs: SignalNames,
    event: str,
    seed: Seed = 0,
) -> Recording:
    """What a poor laboratory would have recorded.

    **Arguments:**

    - `recording`: of three trials or more.
    - `mishap`: its name in `hj.testing.MISHAPS` or `hj.testing.EVENT_MISHAPS`.
    - `input`, two or more `outputs`: names of signals. `event`: of one that comes once in each
      cycle. `seed`: of what happens at random.

    **Raises:** `DefinitionError` for an unknown mishap or signal, and where the result is no
    recording: a clock that runs backwards.
    """
    known = MISHAPS | EVENT_MISHAPS
    if mishap not in known:
        raise DefinitionError(
            f"there is no mishap '{mishap}': see `hj.testing.MISHAPS` and `EVENT_MISHAPS`."
        )
    for name in (input, *outputs):
        recording.column(name)
    names = Names(input, outputs, event)
    return known[mishap](recording, names, np.random.default_rng(seed))
