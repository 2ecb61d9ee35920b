"""Results of many independent points, in memory (`ArrayStore`), or in a Zarr group that any
processes fill (`ZarrStore`).

A piece is a block of points (`Blocks`). In a group it is a chunk of each variable, which appears
complete or not at all and holds its own checksum. A piece is present when all its chunks are, so no
list of finished pieces can be wrong; this must stay so, as processes may end at any time. Files are
not trusted: links, pipes and large descriptions on a disk are refused before anything is read
(`_sizes`), and each chunk is read with its checksum.

`run.py` opens a store by `open_store`, or makes it by `make_store`. If the store of an earlier call
is refused, look at the `description` of the job, which must be equal; if a piece is computed again
without need, at `missing` and `discard_damaged`.
"""

import contextlib
import dataclasses
import itertools
import json
import math
import os
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .. import limits
from ..arguments import package
from ..exceptions import DefinitionError, FileFormatError
from ..progress import counted
from ..results import Result
from .description import difference


_ABOUT = "hybridjax"
# The group of the arrays that only this package reads.
_START = "start"
_CHECKSUM = 4  # bytes of a chunk


@dataclasses.dataclass(frozen=True)
class Blocks:
    """A grid of `shape`, cut into blocks of the shape `block`; the last ones may be smaller."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """Numbers of blocks along each axis."""
        return tuple(-(-n // b) for n, b in zip(self.shape, self.block, strict=True))

    def __len__(self) -> int:
        return math.prod(self.counts)

    def place(self, k: int) -> tuple[int, ...]:
        """Return the indices of block k along each axis."""
        return tuple(map(int, np.unravel_index(k, self.counts)))

    def slices(self, k: int) -> tuple[slice, ...]:
        """Return the part of the grid that is block k."""
        sides = zip(self.place(k), self.block, self.shape, strict=True)
        slices = []
        for i, b, n in sides:
            end = min((i + 1) * b, n)
            slices.append(slice(i * b, end))
        return tuple(slices)


def near_cube(shape: Sequence[int], most: int) -> tuple[int, ...]:
    """Return the shape of a block of at most `most` points that are neighbors: the longest side is
    halved until it fits."""
    block = list(shape)
    while math.prod(block) > most:
        longest = max(range(len(block)), key=block.__getitem__)
        block[longest] = -(-block[longest] // 2)
    return tuple(block)


class Variable(NamedTuple):
    """An array with a value for each point.

    **Fields:** `dims` and `shape`: the axes of each value that follow the axes of the points.
    `attributes`: units for example.
    """

    dtype: str
    dims: tuple[str, ...] = ()
    shape: tuple[int, ...] = ()
    attributes: Mapping[str, Any] = {}

    @property
    def fill(self) -> Any:
        """The value of points that have not been computed."""
        return -1 if np.dtype(self.dtype).kind == "i" else np.nan


def flags(codes: Mapping[str, int]) -> dict[str, Any]:
    """Return the attributes of integers that stand for names, from the code of each name."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def result_flags() -> dict[str, Any]:
    """Return the attributes of a variable with codes of `Result`, which are not consecutive."""
    return flags({x.name.lower(): int(x) for x in Result})


Constant = tuple[Sequence[str], np.ndarray, Mapping[str, Any]]
"""Dimensions, values and attributes of an array that exists before anything is computed."""


class Layout(NamedTuple):
    """Names, shapes and units of results.

    **Fields:** `dims`: axes of the points. `blocks`: the pieces. `variables` and `constants` by
    name. `coordinates`: the constants that are coordinates. `description`: JSON from which the
    results can be told from others.
    """

    dims: tuple[str, ...]
    blocks: Blocks
    variables: Mapping[str, Variable]
    constants: Mapping[str, Constant]
    coordinates: tuple[str, ...]
    description: Mapping[str, Any]

    def array(self, name: str) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Return all dimensions of a variable and its shape."""
        x = self.variables[name]
        return (*self.dims, *x.dims), (*self.blocks.shape, *x.shape)


class ArrayStore:
    """Results in memory. (To import Zarr takes a third of a second.)"""

    address = None

    def __init__(self, layout: Layout):
        self.layout = layout
        arrays: dict[str, Any] = dict(layout.constants)
        for name, x in layout.variables.items():
            dims, shape = layout.array(name)
            arrays[name] = dims, np.full(shape, x.fill, x.dtype), x.attributes
        data = package("xarray").Dataset(arrays).set_coords(layout.coordinates)
        self._data = data.assign_attrs({_ABOUT: json.dumps(layout.description)})

    def missing(self) -> list[int]:
        """Return all pieces."""
        return list(range(len(self.layout.blocks)))

    def write(self, k: int, values: Mapping[str, np.ndarray]) -> None:
        """Keep piece k."""
        for name in self.layout.variables:
            self._data[name].values[self.layout.blocks.slices(k)] = values[name]

    def dataset(self) -> Any:
        """Return all results as `xarray.Dataset`."""
        return self._data


class ZarrStore:
    """Results in a Zarr group; `address` is a path, or an address for fsspec
    ("s3://bucket/a.zarr").

    **Fields:** `layout`, without constants; `start`: the arrays that the store was begun with.
    """

    def __init__(self, address: str):
        """**Raises:** `DefinitionError` if it cannot be opened, is damaged, or holds links, pipes,
        or files that are larger than its chunks."""
        self.address = address
        sizes = _sizes(address)
        try:
            self._group = _group(address, "r+")
            about = json.loads(self._group.attrs[_ABOUT])
            # (Zarr would leave out chunks that hold nothing but the fill value.)
            self._arrays = {
                name: self._group[name].with_config({"write_empty_chunks": True})
                for name in about["variables"]
            }
            first = next(iter(self._arrays.values()))
            p = len(about["dims"])
            arrays = {}
            for name, x in self._arrays.items():
                dims = tuple(x.metadata.dimension_names[p:])
                arrays[name] = Variable(x.dtype.str, dims, x.shape[p:])
            blocks = Blocks(first.shape[:p], first.chunks[:p])
            self.layout = Layout(
                dims=tuple(about["dims"]),
                blocks=blocks,
                variables=arrays,
                constants={},
                coordinates=(),
                description=about["description"],
            )
            # (Zarr would read a chunk that was deleted as zeros.)
            kept = self._group[_START]
            start = [kept[f"{i}"] for i in range(about["start"])]
            whole = [*start, *(self._group[name] for name in about["constants"])]
            lost = {_key(x) for x in whole if x.size} - self._present()
            if lost:
                raise FileNotFoundError(f"{min(lost)} is missing")
            self.start = [np.asarray(x[...]) for x in start]
        except Exception as error:  # (of many kinds)
            raise DefinitionError(
                f"cannot open '{address}' as a store: {error}"
            ) from error
        arrays = self._arrays.values()
        chunk = max(math.prod(x.chunks) * x.dtype.itemsize for x in arrays)
        for path, size in sizes.items():
            if size > max(limits.TEXT, chunk + _CHECKSUM):
                raise DefinitionError(
                    f"'{path}' exceeds all chunks of its store: delete it."
                )

    def missing(self) -> list[int]:
        """Return the pieces of which a chunk is missing."""

        present = self._present()
        pieces = range(len(self.layout.blocks))
        return [k for k in pieces if not present.issuperset(self._chunks(k))]

    def _present(self) -> set[str]:
        async def listed() -> set[str]:
            return {key async for key in self._group.store.list()}

        return package("zarr.core.sync").sync(listed())

    def write(self, k: int, values: Mapping[str, np.ndarray]) -> None:
        """Keep piece k."""
        with _writing(self.address):
            for name, array in self._arrays.items():
                array[(*self.layout.blocks.slices(k), ...)] = values[name]

    def read(self, k: int) -> dict[str, np.ndarray]:
        """Return piece k.

        **Raises:** `FileFormatError` if it is damaged.
        """
        values = {}
        for name, array in self._arrays.items():
            try:
                values[name] = array[(*self.layout.blocks.slices(k), ...)]
            except Exception as error:  # (of many kinds: checksums, sizes, headers)
                raise FileFormatError(
                    f"piece {k} of '{self.address}' is damaged in `{name}`: make the call that "
                    "wrote it again."
                ) from error
        return values

    def array(self, name: str) -> np.ndarray:
        """Return a variable of all pieces, or a constant.

        **Raises:** `FileFormatError` if it is damaged.
        """
        try:
            return np.asarray(self._group[name][...])
        except Exception as error:  # (of many kinds)
            raise FileFormatError(
                f"'{self.address}' is damaged in `{name}`: delete it."
            ) from error

    def discard_damaged(self) -> None:
        """Delete pieces whose checksums are wrong."""
        missing = set(self.missing())
        present = [k for k in range(len(self.layout.blocks)) if k not in missing]
        for k in counted(present, "pieces checked", len(present)):
            try:
                self.read(k)
            except FileFormatError:
                for chunk in self._chunks(k):
                    package("zarr.core.sync").sync(self._group.store.delete(chunk))

    def dataset(self) -> Any:
        """Return all results as `xarray.Dataset`; values are read when they are used."""
        options = {"consolidated": False, "chunks": None, "zarr_format": 3}
        try:
            data = package("xarray").open_zarr(self.address, **options)
        except Exception as error:
            # (Of many kinds, for an array that another program has added.)
            raise FileFormatError(f"'{self.address}' is damaged: {error}") from error
        # (Zarr lists arrays in any order.)
        dims = [name for name in self.layout.dims if name in data.coords]
        known = {*dims, *self._arrays}
        beside = sorted({*data.coords, *data.data_vars} - known)
        description = json.dumps(self.layout.description)
        # (Older stores count the names of results, though codes are not consecutive.)
        if "flag_values" in getattr(data.get("result"), "attrs", {}):
            data["result"].attrs |= result_flags()
        return data[[*dims, *self._arrays, *beside]].assign_attrs({_ABOUT: description})

    def _chunks(self, k: int) -> list[str]:
        """Return the keys of the chunks of piece k. (Along axes that are not those of the points
        there is one chunk.)"""
        return [_key(x, self.layout.blocks.place(k)) for x in self._arrays.values()]


def _key(array: Any, place: tuple[int, ...] = ()) -> str:
    """Return the key of the chunk of a Zarr array at this place of its first axes, 0 on others."""
    zeros = (0,) * (array.ndim - len(place))
    return f"{array.path}/{array.metadata.encode_chunk_key((*place, *zeros))}"


def open_store(address: str, job: Any) -> ZarrStore | None:
    """Return the store of a job's results, without its damaged pieces; None if there is nothing at
    the address.

    **Raises:** `DefinitionError` if it holds other results, or something else.
    """
    sizes = _sizes(address)
    try:
        theirs = json.loads(_group(address, "r").attrs[_ABOUT])["description"]
    except Exception as error:  # (of many kinds)
        if isinstance(error, FileNotFoundError) and not sizes:
            return None
        raise DefinitionError(
            f"'{address}' is no store of results, or only begun ({error!r}): choose another name, "
            "or delete it."
        ) from error
    change = difference(json.loads(json.dumps(job.description)), theirs)
    if change is not None:
        raise DefinitionError(
            f"'{address}' holds other results: {change}. Choose another store."
        )
    store = ZarrStore(address)
    if store.layout.blocks != job.blocks:
        raise DefinitionError(
            f"'{address}' is damaged: delete it, or choose another store."
        )
    store.discard_damaged()
    return store


def make_store(address: str, layout: Layout, start: list[np.ndarray]) -> ZarrStore:
    """Return a new store. It keeps the arrays of `start` for the processes that resume it.

    **Raises:** `DefinitionError` if it cannot be written.
    """
    package("zarr")
    from zarr.codecs import Crc32cCodec

    common = {"compressors": [Crc32cCodec()], "config": {"write_empty_chunks": True}}

    def constant(
        group: Any,
        name: str,
        dims: Sequence[str],
        values: Any,
        attributes: Any = None,
    ):
        values = np.asarray(values)
        group.create_array(
            name,
            data=values,
            chunks=tuple(max(n, 1) for n in values.shape) or "auto",
            dimension_names=dims,
            attributes=dict(attributes or {}),
            **common,
        )

    with _writing(address), warnings.catch_warnings():
        # (Zarr announces that its format of texts may change.)
        warnings.simplefilter("ignore")
        group = _group(address, "a")
        for name, x in layout.variables.items():
            dims, shape = layout.array(name)
            group.create_array(
                name,
                shape=shape,
                chunks=(*layout.blocks.block, *x.shape),
                dtype=x.dtype,
                fill_value=x.fill,
                dimension_names=dims,
                attributes=dict(x.attributes),
                **common,
            )
        for name, x in layout.constants.items():
            constant(group, name, *x)
        kept = group.require_group(_START)
        for i, x in enumerate(start):
            axes = [f"axis_{j}" for j in range(np.ndim(x))]
            constant(kept, f"{i}", axes, x)
        dims = {name: tuple(x[0]) for name, x in layout.constants.items()}
        beside = [name for name in layout.coordinates if dims[name] != (name,)]
        if beside:
            group.attrs["coordinates"] = " ".join(beside)
        about = {
            "description": layout.description,
            "dims": layout.dims,
            "variables": list(layout.variables),
            "constants": list(layout.constants),
            "start": len(start),
        }
        group.attrs[_ABOUT] = json.dumps(about)  # last: from now on it is a store
    return ZarrStore(address)


def absolute(address: Any) -> str:
    """Return an address that is valid in other processes."""
    address = str(address).removeprefix("file://")
    return address if "://" in address else os.path.abspath(address)


def _group(address: str, mode: Any) -> Any:
    # (Arrays of format 2 may be pickled.)
    return package("zarr").open_group(address, mode=mode, zarr_format=3)


def _sizes(address: str) -> dict[str, int]:
    """Return the sizes of all files of a store on disk, in bytes.

    **Raises:** `DefinitionError` if it is or holds a link, through which files of others would be
    read or replaced, or a pipe; or if a description is too large.
    """
    if "://" in address:
        return {}
    paths = [address] if os.path.lexists(address) else []
    for folder, *names in os.walk(address):
        paths += [os.path.join(folder, name) for name in itertools.chain(*names)]
    sizes = {}
    for path in paths:
        about = os.lstat(path)
        if stat.S_ISDIR(about.st_mode):
            continue
        if not stat.S_ISREG(about.st_mode):
            raise DefinitionError(
                f"'{path}' is a link or a pipe, which stores cannot hold."
            )
        if path.endswith(".json") and about.st_size > limits.TEXT:
            raise DefinitionError(f"'{path}' has {about.st_size} bytes: delete it.")
        sizes[path] = about.st_size
    return sizes


@contextlib.contextmanager
def _writing(address: str) -> Iterator[None]:
    """**Raises:** `DefinitionError` if a store cannot be written."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise DefinitionError(f"cannot write to '{address}': {error}") from error
