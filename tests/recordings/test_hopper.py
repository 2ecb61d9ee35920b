"""From a recording to multipliers, where the truth is known."""

import hybridjax as hj
from hybridjax.recordings.spoil import spoil


def test_five_lines(hopper_recording, hopper_cycle, angle):
    data = hj.section_data(hopper_recording, angle, inputs="u", outputs=("yM", "vM"), sections=16)
    fit = hj.fit_series(data.records, order=2)
    assert fit.compare(hopper_cycle.multipliers).max_error < 2e-3
    assert fit.contains(hopper_cycle.multipliers, 0.999).all()
    assert "199.94 cycles" in repr(data)


def test_dirt(hopper_recording, hopper_cycle, angle):
    dirty = spoil(
        hopper_recording, ("yM", "vM"), noise=1e-4, quantum=1e-5, missing=0.01, gap=(80.3, 90.7)
    )
    data = hj.section_data(dirty, angle, inputs="u", outputs=("yM", "vM"), sections=16)
    fit = hj.fit_series(data.records, order=2)
    assert len(data.records) == 2
    assert fit.compare(hopper_cycle.multipliers).max_error < 3e-3
    assert fit.contains(hopper_cycle.multipliers, 0.999).all()
