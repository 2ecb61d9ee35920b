"""What may be wrong with a recording or its file, with the words that should name it.

Plain NumPy: recordings are dictionaries of arrays, files are written by their own libraries. A kind
without words should leave the answer right.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from strangers_truth import Rhythm, rhythm


Trial = dict[str, np.ndarray]
"""`time`, `u`, `x`, `y`, `strike` (times of events) of one trial."""
TRIALS = 4
SECONDS = 60.0


def trial_of(recorded: Rhythm) -> Trial:
    return {
        "time": recorded.time,
        "u": recorded.u,
        "x": recorded.x,
        "y": recorded.y,
        "strike": recorded.strikes,
    }


def clean(seed: int, mu: tuple[float, ...] = (0.35,) * TRIALS) -> list[Trial]:
    """Return trials with the same multiplier, exp(-0.7), or with others."""
    rngs = np.random.default_rng(seed).spawn(len(mu))
    return [
        trial_of(rhythm(rng, SECONDS, mu=value))
        for rng, value in zip(rngs, mu, strict=True)
    ]


class Kind(NamedTuple):
    """A kind of dirt in recordings."""

    name: str
    soil: Callable[[list[Trial], np.random.Generator], list[Trial]]
    words: str = ""
    """A pattern in the finding or error that names it. Empty: the answer should be right."""
    sections: str = "strike"
    """The event, or `trigger` for a crossing of that signal."""


def only(change: Callable[[Trial, np.random.Generator], None], which: int = 1) -> Any:
    """Change one trial."""

    def soil(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
        change(trials[which], rng)
        return trials

    return soil


def every(change: Callable[[Trial, np.random.Generator], None]) -> Any:
    """Change all trials."""

    def soil(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
        for trial in trials:
            change(trial, rng)
        return trials

    return soil


def both_sides(late: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        at = trial["strike"]
        other = (at[1:] + at[:-1]) / 2 + late
        trial["strike"] = np.sort(np.concatenate([at, other]))

    return every(change)


def drifting_stiffness(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
    del trials
    return clean(int(rng.integers(1000)), (0.2, 0.3, 0.4, 0.5))


def trigger(width: float) -> Any:
    """Pulses at the strikes, sampled at 1 kHz."""

    def change(trial: Trial, rng: np.random.Generator) -> None:
        time = np.arange(trial["time"][0], trial["time"][-1], 1e-3)
        since = time - trial["strike"][np.searchsorted(trial["strike"], time) - 1]
        pulse = 5.0 * ((since >= 0) & (since < width))
        for name in ("u", "x", "y"):
            trial[name] = np.interp(time, trial["time"], trial[name])
        trial["trigger"] = pulse
        trial["time"] = time

    return every(change)


def grid(step: float, rate: float | None = None) -> Any:
    """Stamps that are multiples of `step`; `rate`: of samples, if not the first one."""

    def change(trial: Trial, rng: np.random.Generator) -> None:
        if rate is not None:
            time = np.arange(0, trial["time"][-1], 1 / rate)
            for name in ("u", "x", "y"):
                trial[name] = np.interp(time, trial["time"], trial[name])
            trial["time"] = time
        trial["time"] = np.round(trial["time"] / step) * step

    return every(change)


def backwards(trial: Trial, rng: np.random.Generator) -> None:
    for name in ("u", "x", "y"):
        trial[name] = trial[name][::-1].copy()
    trial["strike"] = np.sort(trial["time"][-1] - trial["strike"])


def wrapping(period: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        trial["time"] = np.mod(trial["time"] + period / 3, period)

    return only(change)


def scaled(name: str, factor: float, offset: float = 0.0) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        trial[name] = trial[name] * factor + offset

    return change


def swapped(trial: Trial, rng: np.random.Generator) -> None:
    trial["x"], trial["y"] = trial["y"], trial["x"]


def foreign_input(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
    trials[1]["u"] = trials[2]["u"][::-1].copy()
    return trials


def late_input(seconds: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        trial["u"] = np.roll(trial["u"], round(seconds * 100))

    return change


def jittered(seconds: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        error = seconds * rng.normal(size=len(trial["strike"]))
        trial["strike"] = np.sort(trial["strike"] + error)

    return change


def missing(share: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        trial["strike"] = trial["strike"][rng.random(len(trial["strike"])) > share]

    return change


def doubled(share: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        at = trial["strike"]
        again = at[rng.random(len(at)) < share] + 0.03
        trial["strike"] = np.sort(np.concatenate([at, again]))

    return change


def copied(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
    return [*trials, {name: x.copy() for name, x in trials[0].items()}]


def where(
    name: str, share: float, value: Callable[[np.ndarray, np.random.Generator], Any]
) -> Any:
    """Replace single samples of a signal."""

    def change(trial: Trial, rng: np.random.Generator) -> None:
        rows = rng.random(len(trial[name])) < share
        trial[name] = trial[name].copy()
        trial[name][rows] = value(trial[name][rows], rng)

    return every(change)


def frozen(trial: Trial, rng: np.random.Generator) -> None:
    trial["y"] = trial["y"].copy()
    trial["y"][1000:1700] = trial["y"][1000]


def clipped(trial: Trial, rng: np.random.Generator) -> None:
    trial["y"] = np.minimum(trial["y"], 0.8)


def coarse(trial: Trial, rng: np.random.Generator) -> None:
    trial["y"] = np.round(trial["y"] / 0.05) * 0.05


def tone(frequency: float, size: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        phase = 2 * np.pi * (frequency * trial["time"] + rng.random())
        trial["x"] = trial["x"] + size * np.sin(phase)

    return every(change)


def sensor_drift(trial: Trial, rng: np.random.Generator) -> None:
    walk = np.cumsum(rng.normal(size=len(trial["x"])))
    trial["x"] = trial["x"] + 0.5 * walk / np.abs(walk).max()


def silent(trial: Trial, rng: np.random.Generator) -> None:
    trial["u"] = np.zeros_like(trial["u"])


def answering(trial: Trial, rng: np.random.Generator) -> None:
    trial["u"] = trial["u"] * 0.1 + trial["y"]


def twin(trial: Trial, rng: np.random.Generator) -> None:
    trial["x"] = trial["y"].copy()


def renumbered(trial: Trial, rng: np.random.Generator) -> None:
    """Half a second was lost, and the samples numbered through."""
    kept = np.ones(len(trial["time"]), bool)
    kept[3000:3050] = False
    for name in ("u", "x", "y"):
        trial[name] = trial[name][kept]
    at = trial["strike"]
    inside = (at >= 30.0) & (at < 30.5)
    trial["strike"] = np.where(at > 30.0, at - 0.5, at)[~inside]
    trial["time"] = trial["time"][: kept.sum()]


def pause(trial: Trial, rng: np.random.Generator) -> None:
    """The clock ran on for ten seconds while nothing was recorded."""
    kept = np.abs(trial["time"] - 30) > 5
    for name in ("time", "u", "x", "y"):
        trial[name] = trial[name][kept]
    trial["strike"] = trial["strike"][np.abs(trial["strike"] - 30) > 5]


def events_in(factor: float) -> Any:
    def change(trial: Trial, rng: np.random.Generator) -> None:
        trial["strike"] = trial["strike"] * factor

    return every(change)


def foreign_events(trials: list[Trial], rng: np.random.Generator) -> list[Trial]:
    trials[1]["strike"] = trials[2]["strike"] + 0.37
    return trials


def faster(trial: Trial, rng: np.random.Generator) -> None:
    trial["time"] = trial["time"] / 1.1
    trial["strike"] = trial["strike"] / 1.1


def saturated(trial: Trial, rng: np.random.Generator) -> None:
    """The command is recorded; the actuator gave less to strong ones, which nothing shows."""
    trial["u"] = np.sign(trial["u"]) * np.abs(trial["u"]) ** 1.5


def repeated_times(trial: Trial, rng: np.random.Generator) -> None:
    trial["time"] = trial["time"].copy()
    trial["time"][500] = trial["time"][499]


def unsorted(trial: Trial, rng: np.random.Generator) -> None:
    trial["time"] = trial["time"].copy()
    trial["time"][[500, 501]] = trial["time"][[501, 500]]


def averaged(trial: Trial, rng: np.random.Generator) -> None:
    """Outputs after a moving mean of 0.3 s, not causal, as some programs export them."""
    window = np.ones(31) / 31
    for name in ("x", "y"):
        trial[name] = np.convolve(trial[name], window, "same")


def opposite(trial: Trial, rng: np.random.Generator) -> None:
    """Strikes of the other side: half a cycle later."""
    at = trial["strike"]
    trial["strike"] = (at[1:] + at[:-1]) / 2


def constant(trial: Trial, rng: np.random.Generator) -> None:
    trial["x"] = np.full_like(trial["x"], 3.0)


def no_events(trial: Trial, rng: np.random.Generator) -> None:
    trial["strike"] = trial["strike"][:1]


RECORDINGS = [
    Kind("clean", lambda trials, rng: trials),
    Kind("strikes of both sides", both_sides(0.0), "left and the right"),
    Kind("strikes of both sides, uneven", both_sides(0.05), "left and the right"),
    Kind("stiffness drifts over trials", drifting_stiffness, "change along the data"),
    Kind("trigger of 1 ms", trigger(1e-3), sections="trigger"),
    Kind("trigger of 3 ms", trigger(3e-3), sections="trigger"),
    Kind("trigger of 10 ms", trigger(1e-2), sections="trigger"),
    Kind("stamps on a grid of 4.3 ms", grid(4.3e-3), "are multiples of"),
    Kind("60 Hz, stamps of 10 ms", grid(0.01, 60.0), "are multiples of"),
    Kind("a trial backwards", only(backwards), "backwards"),
    Kind("a clock of 15 bits", wrapping(32.768), "numpy.unwrap.*32.768"),
    Kind("a clock of minutes", wrapping(40.0), "numpy.unwrap.*period=40"),
    Kind("times in ms in a trial", only(scaled("time", 1e3)), "unit|outside"),
    Kind("x in mm in a trial", only(scaled("x", 1e3)), "unit"),
    Kind("x in degrees in a trial", only(scaled("x", 57.2958)), "unit"),
    Kind("x with another zero", only(scaled("x", 1.0, 3.0)), "median of x"),
    Kind("x and y swapped", only(swapped), "places|other sign|begin|average cycle"),
    Kind("u of the other sign", only(scaled("u", -1.0)), "opposite sign"),
    Kind("y of the other sign", only(scaled("y", -1.0)), "other sign"),
    Kind("u of another trial", foreign_input, "another trial"),
    Kind("u 0.7 s late in a trial", only(late_input(0.7)), "came earlier or later"),
    Kind("strikes scatter by 30 ms", every(jittered(0.03)), "scatter"),
    Kind("5 % of the strikes missing", every(missing(0.05))),
    Kind("5 % of the strikes doubled", every(doubled(0.05))),
    Kind("a trial twice", copied, "count once"),
    Kind("y frozen for 7 s", only(frozen), "does not change"),
    Kind("y clipped", every(clipped), "cut off"),
    Kind("spikes of x", where("x", 1e-3, lambda x, rng: x + 5.0), "outliers|spike"),
    Kind("-9999 in x", where("x", 1e-2, lambda x, rng: -9999.0), "stand for no value"),
    Kind("1e20 in y", where("y", 1e-2, lambda x, rng: 1e20), "stand for no value"),
    Kind("a third of x missing", where("x", 0.3, lambda x, rng: np.nan)),
    Kind("y in steps of 0.05", every(coarse)),
    Kind("hum at 1.3 Hz", tone(1.3, 0.2), "hum|held-out|order"),
    Kind("drift of x", every(sensor_drift), "drifts|drift"),
    Kind("no push in a trial", only(silent), "does not change in trial"),
    Kind("u answers y", every(answering), "biased|answer|contains"),
    Kind("x is y", every(twin), "same numbers"),
    Kind("lost samples, renumbered", only(renumbered), "numbered anew"),
    Kind("a pause", only(pause), "jump|pause"),
    Kind("strikes in samples", events_in(100.0), "unit"),
    Kind("strikes in ms", events_in(1e3), "unit"),
    Kind("strikes of another trial", foreign_events, "begin|average cycle|scatter"),
    Kind("a faster trial", only(faster), "another period|last"),
    Kind("repeated times", only(repeated_times), "leave out such"),
    Kind("samples out of order", only(unsorted), "sort the samples"),
    Kind("strikes of the other side", only(opposite), "begin"),
    Kind("x constant", every(constant), "constant|does not change"),
    Kind("no strikes in a trial", only(no_events), "events|strike|cycles"),
    Kind("all u 50 ms late", every(late_input(0.05))),
    Kind("a command, not the force", every(saturated)),
    Kind("outputs averaged over 0.3 s", every(averaged)),
]


class FileKind(NamedTuple):
    """A kind of dirt in a file of a trial, whose `y` is compared."""

    name: str
    write: Callable[[Path, Trial], Path]
    words: str = ""
    """A pattern of what is said of it; otherwise `y` is right."""
    signals: tuple[str, ...] | None = None


HEADER = "time (s),x (mm),y (N)"


def rows_of(trial: Trial, separator: str = ",") -> list[str]:
    columns = zip(trial["time"], trial["x"], trial["y"], strict=True)
    return [separator.join(f"{value:.9g}" for value in row) for row in columns]


def text(
    change: Callable[[list[str]], list[str]],
    header: str = HEADER,
    encoding: str = "utf-8",
    separator: str = ",",
) -> Any:
    """Write a table whose lines are changed."""

    def write(folder: Path, trial: Trial) -> Path:
        path = folder / "trial.csv"
        lines = change([header, *rows_of(trial, separator)])
        path.write_bytes("\n".join(lines).encode(encoding))
        return path

    return write


def replaced(number: int, line: Callable[[str], str]) -> Any:
    def change(lines: list[str]) -> list[str]:
        lines[number] = line(lines[number])
        return lines

    return change


def cell(column: int, value: str, number: int = 100) -> Any:
    def line(old: str) -> str:
        fields = old.split(",")
        fields[column] = value
        return ",".join(fields)

    return replaced(number, line)


def with_text(lines: list[str]) -> list[str]:
    return [lines[0] + ",phase", *(line + ",stance" for line in lines[1:])]


def y_first(lines: list[str]) -> list[str]:
    """The second column of a table stands first, and one of its cells has no number."""
    moved = []
    for line in lines:
        time, x, y = line.split(",")
        moved.append(",".join([x, time, y]))
    return cell(0, "#N/A", 40)(moved)


def clock_times(lines: list[str]) -> list[str]:
    def stamp(k: int) -> str:
        return f"12:{k // 6000:02d}:{k / 100 % 60:05.2f}"

    changed = [lines[0].replace(" (s)", "")]
    for k, line in enumerate(lines[1:]):
        changed.append(",".join([stamp(k), *line.split(",")[1:]]))
    return changed


def latin_comment(folder: Path, trial: Trial) -> Path:
    path = folder / "trial.csv"
    header = "time (s),x (µm),y (N),Öffnung (°)"
    lines = [header, *(line + ",1" for line in rows_of(trial))]
    path.write_bytes(b"# M\xfcller\n" + "\n".join(lines).encode("utf-8"))
    return path


def with_commas(lines: list[str]) -> list[str]:
    return [lines[0], *(line.replace(".", ",") for line in lines[1:])]


def twice(lines: list[str]) -> list[str]:
    """Two exports, one below the other."""
    return [*lines, *lines]


def two_runs(lines: list[str]) -> list[str]:
    return [*lines, *lines[1:]]


def packed_netcdf(folder: Path, trial: Trial) -> Path:
    h5py = __import__("h5py")
    path = folder / "trial.nc"
    with h5py.File(path, "w") as file:
        file["time"] = trial["time"]
        file["time"].attrs["units"] = "seconds since 2026-01-01 00:00:00"
        file["y"] = np.round((trial["y"] - 4.0) / 1e-4).astype(np.int32)
        file["y"].attrs["scale_factor"] = 1e-4
        file["y"].attrs["add_offset"] = 4.0
    return path


def filled_netcdf(folder: Path, trial: Trial) -> Path:
    h5py = __import__("h5py")
    path = folder / "trial.h5"
    stored = np.round(trial["y"] / 1e-4).astype(np.int32)
    stored[50:60] = -32767
    with h5py.File(path, "w") as file:
        file["time"] = trial["time"]
        file["y"] = stored
        file["y"].attrs["scale_factor"] = 1e-4
        file["y"].attrs["_FillValue"] = np.int32(-32767)
    trial["y"] = trial["y"].copy()
    trial["y"][50:60] = np.nan
    return path


def classic_netcdf(folder: Path, trial: Trial) -> Path:
    from scipy.io import netcdf_file

    path = folder / "trial.nc"
    with netcdf_file(path, "w") as file:
        file.createDimension("time", len(trial["time"]))
        time = file.createVariable("time", "d", ("time",))
        time[:] = trial["time"]
        time.units = "s"
        y = file.createVariable("y", "i", ("time",))
        y[:] = np.round((trial["y"] - 4.0) / 1e-4).astype(np.int32)
        y.scale_factor = 1e-4
        y.add_offset = 4.0
    return path


def long_c3d(folder: Path, trial: Trial) -> Path:
    """70 000 frames, more than the 16 bits of the header count."""
    ezc3d = __import__("ezc3d")
    file = ezc3d.c3d()
    frames = 70_000
    file["parameters"]["POINT"]["RATE"]["value"] = [200]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["y"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    points = np.ones((4, 1, frames))
    points[0, 0] = np.resize(trial["y"], frames)
    file["data"]["points"] = points
    path = folder / "trial.c3d"
    file.write(str(path))
    return path


def mcap(spoil: Callable[[bytearray], bytearray]) -> Any:
    def write(folder: Path, trial: Trial) -> Path:
        rosbag2 = __import__("rosbags.rosbag2", fromlist=["Writer"])
        typesys = __import__("rosbags.typesys", fromlist=["Stores"])
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        message = store.types["std_msgs/msg/Float64"]
        plugin = rosbag2.StoragePlugin.MCAP
        with rosbag2.Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
            topic = writer.add_connection("/y", message.__msgtype__, typestore=store)
            for t, value in zip(trial["time"], trial["y"], strict=True):
                data = store.serialize_cdr(message(float(value)), message.__msgtype__)
                writer.write(topic, 10**9 + round(t * 1e9), data)
        (source,) = (folder / "bag").glob("*.mcap")
        path = folder / "trial.mcap"
        path.write_bytes(spoil(bytearray(source.read_bytes())))
        return path

    return write


def blanked(data: bytearray) -> bytearray:
    middle = len(data) // 3
    data[middle : middle + 300] = bytes(300)
    return data


def cut(data: bytearray) -> bytearray:
    return data[: len(data) // 2]


def pickled(folder: Path, trial: Trial) -> Path:
    """Bytes of another program under the name of a table."""
    path = folder / "trial.csv"
    path.write_bytes(struct.pack("<100d", *trial["y"][:100]))
    return path


FILES = [
    FileKind("clean table", text(lambda lines: lines)),
    FileKind("#N/A in a first cell", text(cell(0, "#N/A")), "sample"),
    FileKind(
        "#N/A in the first cell of a row",
        text(y_first),
    ),
    FileKind("#DIV/0! in a cell", text(cell(2, "#DIV/0!")), "is not a number"),
    FileKind("#VALUE! in a first cell", text(cell(0, "#VALUE!")), "is not a number"),
    FileKind("inf in a cell", text(cell(2, "inf")), "infinite"),
    FileKind("a column of text", text(with_text), "of text"),
    FileKind("a column of text, others wanted", text(with_text), signals=("x", "y")),
    FileKind("times of day", text(clock_times), "is not a number"),
    FileKind("one byte of Latin-1", latin_comment),
    FileKind("Latin-1", text(lambda x: x, "time (s),Öffnung (°),y (N)", "latin-1")),
    FileKind(
        "UTF-16 without a mark",
        text(lambda x: x, encoding="utf-16-le"),
        "not a text file",
    ),
    FileKind("commas in numbers and between", text(with_commas), "fields"),
    FileKind(
        "decimal commas, semicolons",
        text(with_commas, "time (s);x (mm);y (N)", separator=";"),
        "decimal commas",
    ),
    FileKind("two exports in a file", text(twice), "is not a number"),
    FileKind("two runs in a file", text(two_runs), "new trial begins"),
    FileKind(
        "a cut last line", text(replaced(-1, lambda x: x[: len(x) // 4])), "fields|"
    ),
    FileKind("no times", text(lambda x: x, "t0 (s),x (mm),y (N)"), "no column 'time'"),
    FileKind("times in frames", text(lambda x: x, "time (frame),x,y"), "convert them"),
    FileKind("two columns of a name", text(lambda x: x, "time (s),y,y"), "two columns"),
    FileKind("bytes of another program", pickled, "not a text file"),
    FileKind("NetCDF 4, packed", packed_netcdf),
    FileKind("HDF5 with marks of missing", filled_netcdf),
    FileKind("NetCDF 3, packed", classic_netcdf),
    FileKind("C3D of 70 000 frames", long_c3d, "only 65535 can be read"),
    FileKind("MCAP with a hole", mcap(blanked), "damaged"),
    FileKind("half an MCAP", mcap(cut), "damaged"),
]
