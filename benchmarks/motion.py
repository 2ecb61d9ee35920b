"""How fast pictures follow: CPU seconds of a slider's move, and of an animation's first picture.

    python benchmarks/motion.py

A move is of 1/50 of the range, after 50 moves, with the picture that is sent to the browser; the
gain follows once the slider rests. The first picture is that of a process that has found the cycle
and has drawn nothing before; it includes the import of matplotlib. The file is a GIF of 5 s.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import hybridjax as hj


MOVES = {"VerticalHopper": ("k", 9.0, 11.0), "CompassGait": ("slope", 0.045, 0.06)}


def moves(name: str) -> None:
    parameter, low, high = MOVES[name]
    explorer = hj.explore(getattr(hj.models, name)(), parameter)
    rows = []
    for number, value in enumerate(
        [*np.linspace(low, high, 51), *np.linspace(high, low, 51)]
    ):
        marks = [time.process_time()]
        for gain in (False, True):
            explorer._answer({parameter: value}, gain, number)
            marks.append(time.process_time())
        rows.append(np.diff(marks))
    move, gain = np.median(rows[51:], axis=0)
    last = np.quantile(np.array(rows[51:])[:, 0], 0.9)
    print(
        f"{name}.move {move:.3f} s (nine of ten below {last:.3f} s), gain {gain:.3f} s"
    )


def first(name: str) -> None:
    cycle = hj.find_limit_cycle(getattr(hj.models, name)())
    begin = time.process_time()
    motion = hj.plot.animate(cycle)
    motion.figure.canvas.draw()
    print(f"{name}.first {time.process_time() - begin:.2f} s")
    if name == "VerticalHopper":
        with tempfile.TemporaryDirectory() as folder:
            slow = hj.plot.animate(cycle, speed=0.2)
            size = slow.save(Path(folder, "hopper.gif")).stat().st_size
        print(
            f"{name}.gif {size / 1000:.0f} kB, {slow.interval * len(slow.times):.1f} s"
        )


if __name__ == "__main__":
    hj.enable_x64()
    if len(sys.argv) > 1:
        first(sys.argv[1])
    else:
        for model in MOVES:
            moves(model)
        for model in (*MOVES, "FiveLinkBiped"):
            subprocess.run([sys.executable, __file__, model], check=True)
