"""Recordings and section data as `xarray.Dataset`."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.signal import Signal
from ..errors import DefinitionError
from ..experiments.record import Record
from ..recordings.data import SectionData
from ..recordings.recording import Recording
from .modules import REST


# Names of coordinates, and of what tells of events.
_RESERVED = {"time", "trial", "event", "event_time", "event_trial"}


def from_recording(recording: Recording) -> Any:
    """A variable for each signal, along the samples of all trials."""
    trials = recording.trials
    _refuse_reserved(recording.signals)
    values = np.concatenate([t.values for t in trials])
    units = zip(recording.signals, recording.units, strict=True)
    variables: dict[str, Any] = {
        name: ("sample", x, {"units": unit} if unit else {})
        for (name, unit), x in zip(units, values.T, strict=True)
    }
    events = [
        (s, name, at)
        for s, t in enumerate(trials)
        for name, times in t.events.items()
        for at in times
    ]
    variables["event"] = "occurrence", np.array([name for _, name, _ in events], str)
    coordinates = {
        "time": ("sample", np.concatenate([t.time for t in trials]), {"units": "s"}),
        "trial": ("sample", np.repeat(np.arange(len(trials)), [len(t.time) for t in trials])),
        "event_time": ("occurrence", np.array([at for *_, at in events], float), {"units": "s"}),
        "event_trial": ("occurrence", np.array([s for s, *_ in events], int)),
    }
    rest = {
        "kind": "Recording",
        "trials": [{"name": t.name, "events": list(t.events)} for t in trials],
        "notes": recording.notes,
    }
    return package("xarray").Dataset(variables, coordinates, {REST: json.dumps(rest)})


def to_recording(dataset: Any, rest: Mapping[str, Any]) -> Recording:
    """The recording of a dataset of `from_recording`; samples and signals may have been selected.

    **Raises:** `DefinitionError` if it is none, and as `Recording`.
    """
    trials = []
    try:
        names = [str(x) for x in dataset.data_vars if x != "event"]
        own = {x: dataset[x].attrs.get("units", "") for x in names}
        units = {name: unit for name, unit in own.items() if unit}
        for s in np.unique(dataset["trial"].values):
            about, here = rest["trials"][s], dataset["trial"].values == s
            events = {
                name: dataset["event_time"].values[
                    (dataset["event_trial"].values == s) & (dataset["event"].values == name)
                ]
                for name in about["events"]
            }
            signals = {name: dataset[name].values[here] for name in names}
            trials.append(
                Recording(
                    dataset["time"].values[here],
                    signals,
                    events=events,
                    units=units,
                    name=about["name"],
                    notes=rest["notes"],
                )
            )
    except (KeyError, IndexError, TypeError) as error:
        raise DefinitionError(f"the dataset is no Recording: {error}") from error
    return Recording.join(trials)


def from_section_data(data: SectionData) -> Any:
    """A variable for each input and output, along the sections of all records; `average_cycle`."""
    _refuse_reserved(data.signals)
    records, N = data.records, data.n_sections
    lengths = [len(r.u) for r in records]
    values = np.concatenate([np.concatenate([r.u, r.y], axis=1) for r in records])
    variables: dict[str, Any] = {
        str(name): ("sample", x, {"units": unit} if unit else {})
        for name, unit, x in zip(data.signals, data.units, values.T, strict=True)
    }
    cycle = np.concatenate([data.cycle_inputs, data.cycle_outputs], axis=1)
    variables["average_cycle"] = ("phase", "signal"), cycle
    coordinates = {
        "time": ("sample", np.concatenate(data.times), {"units": "s"}),
        "trial": ("sample", np.repeat(data.trials, lengths)),
        "record": ("sample", np.repeat(np.arange(len(records)), lengths)),
        "section": (
            "sample",
            np.concatenate([(r.first_section + np.arange(len(r.u))) % N for r in records]),
        ),
        "phase": np.arange(N) / N,
        "signal": list(map(str, data.signals)),
    }
    rest = {
        "kind": "SectionData",
        "inputs": list(map(str, data.inputs)),
        "spikes": data.spikes,
        "records": [{"drift": r.drift, "lead": r.lead} for r in records],
    }
    attributes = {"n_sections": N, "period": data.period, "bandwidth": data.bandwidth}
    return package("xarray").Dataset(variables, coordinates, attributes | {REST: json.dumps(rest)})


def to_section_data(dataset: Any, rest: Mapping[str, Any]) -> SectionData:
    """The data of a dataset of `from_section_data`; records may have been selected.

    **Raises:** `DefinitionError` if it is none.
    """
    records, times, trials = [], [], []
    try:
        signals = [str(x) for x in dataset["signal"].values]
        units = [dataset[name].attrs.get("units", "") for name in signals]
        names = [Signal(*pair) for pair in zip(signals, units, strict=True)]
        values = np.stack([dataset[name].values for name in signals], axis=1)
        nu, N = len(rest["inputs"]), int(dataset.attrs["n_sections"])
        about = {"n_sections": N, "inputs": tuple(names[:nu]), "outputs": tuple(names[nu:])}
        for k in np.unique(dataset["record"].values):
            here = dataset["record"].values == k
            first = int(dataset["section"].values[here][0])
            u, y = values[here, :nu], values[here, nu:]
            records.append(Record(u, y, first_section=first, **about, **rest["records"][k]))
            times.append(dataset["time"].values[here])
            trials.append(int(dataset["trial"].values[here][0]))
        cycle = dataset["average_cycle"].transpose("phase", "signal").values
        return SectionData(
            tuple(records), tuple(times), tuple(trials), cycle[:, :nu], cycle[:, nu:],
            float(dataset.attrs["period"]), float(dataset.attrs["bandwidth"]),
            tuple(rest["spikes"]),
        )  # fmt: skip
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DefinitionError(f"the dataset is no SectionData: {error}") from error


def _refuse_reserved(names: tuple[str, ...]) -> None:
    """**Raises:** `DefinitionError` for signals that are called like a coordinate."""
    taken = _RESERVED & set(names)
    if taken:
        raise DefinitionError(f"the signal '{min(taken)}' is called like a coordinate: rename it.")
