"""Experiments on disk, chunk by chunk: many more than memory holds, by any number of processes.

A folder of experiments holds a file `experiments.json`, which says what they are, and one file for
each chunk, an `ExperimentData` as `save` writes it. A chunk appears complete or not at all.
"""

import dataclasses
import hashlib
import json
import operator
import reprlib
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Unpack

import equinox as eqx
import jax
import numpy as np

from .._core import limits
from .._core.boundary.checked import checked
from .._core.boundary.kinds import ExperimentCount, Index, Path as PathLike
from .._core.files.archive import read_module, write_module
from .._core.files.npz import damaged
from .._core.files.writing import made_folder, replacing
from .._core.progress import counted, working
from ..errors import DefinitionError, FileFormatError
from ..maps.placed import SectionsLike
from ..orbits.cycle import LimitCycle
from ..systems.output import OutputNames
from .campaign import Campaign, chunks, prepare
from .data import ExperimentData, summary
from .design.design import Design
from .inputs import DesignLike
from .options import OptionsByName, options_of
from .run import CHUNK


_MANIFEST = "experiments.json"
_FORMAT = "hybridjax experiments 4"
_DIGITS = 9  # more than numbers of chunks have
# Cycles found on different machines are the same up to this: their times relative to the period,
# their states relative to the states' sizes. Twice as much takes cycles for the same that differ
# twice as much.
_SAME_CYCLE = 1e-7
# Sizes of states, which accuracies are relative to, are the same up to this factor: the size of a
# state that rests at zero is that of rounding errors, which differ from machine to machine. Twice
# as much takes accuracies for the same that differ twice as much.
_SAME_SIZES = 4.0


@checked
@working("store_experiments")
def store_experiments(
    folder: PathLike,
    cycle: LimitCycle,
    sections: SectionsLike,
    design: DesignLike,
    outputs: OutputNames,
    *,
    chunk: ExperimentCount = CHUNK,
    share: tuple[Index, ExperimentCount] = (0, 1),
    **options: Unpack[OptionsByName],
) -> "StoredExperiments":
    """Run experiments and write them to a folder, in memory that does not depend on their number.

    Chunks that are there already are not run again: after an interruption, make the same call.

    **Arguments:** as for `run_experiments`, and

    - `folder`: is created where needed. It holds the experiments of one call only.
    - `chunk`: the number of experiments in one file.
    - `design`: an array may lie on disk (`numpy.load(file, mmap_mode="r")`).
    - `share`: `(rank, size)` of this process where several, perhaps on several machines, make the
        same call on the same folder: it runs the chunks rank, rank + size, ...

    **Returns:** `StoredExperiments`.

    **Raises:** `DefinitionError` if the folder holds experiments on another system, cycle, family
    or design, or cannot be written; `FileFormatError` for a chunk that is damaged; `TypeError`
    for an argument that does not exist; and as `run_experiments`.
    """
    rank, size = share
    if rank >= size:
        raise DefinitionError(f"share is (rank, size) with 0 <= rank < size, not {share}.")
    chosen, folder = options_of(store_experiments, options), Path(folder)
    with made_folder(folder):
        campaign = prepare(cycle, sections, design, outputs, chosen, chunk)
        parts = chunks(len(campaign.inputs), chunk)
        if len(parts) > limits.DECLARED:
            raise DefinitionError(
                f"{len(campaign.inputs)} experiments in chunks of {chunk} are more than "
                f"{limits.DECLARED} files: take a larger `chunk`."
            )
        _open(folder, _describe(campaign, chunk))
    stored = StoredExperiments(folder)
    missing = [k for k in stored.missing() if k % size == rank]
    for k in counted(missing, "chunks", len(missing)):
        path = stored.path(k)
        write_module(path, campaign.run(parts[k]), path.stem)
    return stored


@checked
class StoredExperiments:
    """Experiments in a folder that `store_experiments` fills.

    Iterating over them reads chunk after chunk as `ExperimentData`, so that
    `estimate_htf(StoredExperiments(folder))` needs memory for one chunk only.
    """

    def __init__(self, folder: PathLike):
        """**Arguments:** `folder`.

        **Raises:** `DefinitionError` if `folder` holds no experiments, or chunks of others;
        `FileFormatError` for an `experiments.json` that is damaged.
        """
        self.folder = Path(folder)
        about = _read(self.folder)
        if about is None:
            raise DefinitionError(f"'{folder}' holds no experiments: there is no {_MANIFEST}.")
        self._id = _identity(about)
        self.experiments, self.chunk, self.n_sections = (
            _count(self.folder, about, name) for name in ("experiments", "chunk", "n_sections")
        )
        if len(self) > limits.DECLARED:
            raise damaged(self.folder / _MANIFEST, f"it declares {len(self)} chunks")
        for name in sorted(p.name for p in self.folder.glob("[!.]*.npz")):
            number = name.partition("-")[0]
            k = int(number) if number.isdecimal() and len(number) < _DIGITS else len(self)
            if k >= len(self) or name != self.path(k).name:
                raise DefinitionError(
                    f"'{self.folder / name}' does not belong to the experiments that "
                    f"'{_MANIFEST}' describes: take it out of the folder."
                )

    def __len__(self) -> int:
        """The number of chunks, whether they are there or not."""
        return -(-self.experiments // self.chunk)

    def path(self, k: Index) -> Path:
        """The file of chunk k, which holds the experiments from `k * chunk` on."""
        return self.folder / f"{k:06d}-{self._id}.npz"

    def missing(self) -> list[int]:
        """The chunks that are not there yet.

        **Raises:** `FileFormatError` for a chunk that is damaged.
        """
        gone = []
        there = {path.name for path in self.folder.iterdir()}
        for k in range(len(self)):
            if self.path(k).name not in there:
                gone.append(k)
            elif not zipfile.is_zipfile(self.path(k)):
                raise damaged(self.path(k), "delete it, and it will be run again")
        return gone

    def __iter__(self) -> Iterator[ExperimentData]:
        """Read chunk after chunk. **Raises:** `DefinitionError` if one is missing;
        `FileFormatError` if one is damaged, or is not the one that was written there."""
        self._complete()
        for k in range(len(self)):
            path = self.path(k)
            yield read_module(path, {"ExperimentData": ExperimentData}, path.stem)

    def summary(self, limit: Index = 5) -> str:
        """As `ExperimentData.summary`, of all experiments."""
        result, failed_at = zip(*((part.result, part.failed_at) for part in self), strict=True)
        return summary(np.concatenate(result), np.concatenate(failed_at), self.n_sections, limit)

    def _complete(self) -> None:
        gone = self.missing()
        if gone:
            raise DefinitionError(
                f"{len(gone)} of {len(self)} chunks in '{self.folder}' are missing, the first is "
                f"{gone[0]}: call `store_experiments` as before to run them."
            )

    def __repr__(self) -> str:
        ready = len(self) - len(self.missing())
        return (
            f"StoredExperiments('{self.folder}': {self.experiments} experiments, {ready} of "
            f"{len(self)} chunks)"
        )


def _open(folder: Path, about: dict[str, Any]) -> None:
    """Describe the experiments in the folder, or check that it was made for the same ones."""
    if (there := _read(folder)) is None:
        with replacing(folder / _MANIFEST) as path:
            path.write_text(json.dumps(about, indent=1))
        there = _read(folder)
    assert there is not None
    for name, value in about.items():
        same = _same_cycle if name == "cycle" else operator.eq
        if not same(value, there.get(name)):
            raise DefinitionError(
                f"'{folder}' holds other experiments (its `{name}` is not the same): give these "
                "a folder of their own."
            )


def _read(folder: Path) -> dict[str, Any] | None:
    path = folder / _MANIFEST
    try:
        if path.stat().st_size > limits.TEXT:
            raise ValueError
        about = json.loads(path.read_text())
        if about["format"] != _FORMAT:
            raise KeyError
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError, OSError, RecursionError) as error:
        raise FileFormatError(f"'{path}' is damaged, or of another version.") from error
    return about


def _count(folder: Path, about: dict[str, Any], name: str) -> int:
    """A whole number above zero in the manifest."""
    value = about.get(name)
    if type(value) is not int or value < 1:
        raise damaged(folder / _MANIFEST, f"`{name}` is {reprlib.repr(value)}")
    return value


def _describe(campaign: Campaign, chunk: int) -> dict[str, Any]:
    """What makes these experiments what they are."""
    placed, inputs, noise = campaign.placed, campaign.inputs, campaign.process_noise
    system, lanes, stepping = placed.cycle.system, placed.lanes, campaign.stepping
    if isinstance(inputs.source, Design):
        design = eqx.partition(inputs.source, eqx.is_array)
        digest = _digest([*jax.tree_util.tree_leaves(design[0]), repr(design[1].input_names)])
    else:
        digest = _digest([inputs.source])
    return {
        "format": _FORMAT,
        "experiments": len(inputs),
        "chunk": chunk,
        "cycles": inputs.cycles,
        "periods": inputs.periods,
        "n_sections": placed.n_sections,
        "start": campaign.start.name,
        "process_noise": None if noise is None else dataclasses.asdict(noise),
        "record_events": campaign.record_events,
        "inputs": list(system.inputs),
        "outputs": list(campaign.outputs.names),
        "system": type(system).__qualname__,
        "family": placed.family.label,
        "parameters": _digest(jax.tree_util.tree_leaves((system, placed.family))),
        "accuracy": stepping.accuracy,
        "precision": campaign.execution.precision,
        "design": digest,
        "cycle": {
            "points": np.concatenate([lanes.t[None], lanes.q]).T.tolist(),
            "scales": np.asarray(stepping.scales).tolist(),
        },
    }


def _same_cycle(mine: dict[str, Any], theirs: Any) -> bool:
    """Whether the sections lie on the same cycle; each is described by its points (t, q) at the
    sections and by the scales of these, of which that of time is the period."""
    points, scales = np.array(mine["points"]), np.array(mine["scales"])
    try:
        others, other_scales = (np.array(theirs[x], float) for x in ("points", "scales"))
    except (TypeError, ValueError, KeyError):
        return False
    if (points.shape, scales.shape) != (others.shape, other_scales.shape):
        return False
    apart = np.abs(points - others) / scales
    ratio = other_scales / scales
    period, sizes = ratio[:, 0], ratio[:, 1:]
    return bool(
        max(np.max(apart), np.max(np.abs(period - 1))) <= _SAME_CYCLE
        and np.all((sizes <= _SAME_SIZES) & (sizes >= 1 / _SAME_SIZES))
    )


def _identity(about: dict[str, Any]) -> str:
    """A short name of the experiments, for their files."""
    return _digest([json.dumps(about, sort_keys=True)])[:8]


def _digest(things: Sequence[Any]) -> str:
    """A hash of arrays, numbers and texts, a part of them at a time."""
    sha = hashlib.sha256()
    for x in things:
        if isinstance(x, str):
            sha.update(x.encode())
        elif eqx.is_array_like(x) or isinstance(x, np.ndarray):
            array = np.atleast_1d(np.asarray(x))
            sha.update(f"{array.dtype}{array.shape}".encode())
            for k in range(0, len(array), 1024):
                sha.update(np.ascontiguousarray(array[k : k + 1024]).tobytes())
    return sha.hexdigest()
