"""Results in a Zarr group, which any number of processes fill.

A piece is a chunk of each variable. A chunk appears complete or not at all, and holds its own
checksum; a piece is there when all its chunks are. So there is no list that could be wrong.
"""

import contextlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...errors import DefinitionError, FileFormatError
from ..arguments import package
from ..progress import counted
from .blocks import Blocks
from .description import difference
from .layout import Constant, Layout, Variable


_ABOUT = "hybridjax"
# Where arrays are kept that only this package reads.
_START = "start"


class ZarrStore:
    """See `Store`. `address` is a path, or an address that fsspec knows ("s3://bucket/map.zarr")."""

    def __init__(self, address: str):
        self.address = address
        with _writing(address):
            self._group = _group(address, "r+")
            about = json.loads(self._group.attrs[_ABOUT])
            # (Zarr would leave out chunks that hold nothing but the fill value.)
            self._arrays = {
                name: self._group[name].with_config({"write_empty_chunks": True})
                for name in about["variables"]
            }
            self.layout = _layout(self._arrays, about)

    @property
    def start(self) -> list[np.ndarray]:
        """The arrays that it was begun with."""
        kept = self._group[_START]
        return [np.asarray(kept[f"{i}"][...]) for i in range(len(list(kept.array_keys())))]

    def missing(self) -> list[int]:
        there = [self._there(name) for name in self.layout.variables]
        return [k for k in range(len(self.layout.blocks)) if not all(k in x for x in there)]

    def has(self, k: int) -> bool:
        """Whether piece k is there."""
        from zarr.core.sync import sync

        return all(sync(x.store.exists(_chunk(x, self._place(x, k)))) for x in self._each())

    def write(self, k: int, values: Mapping[str, np.ndarray]) -> None:
        with _writing(self.address):
            for name, array in self._arrays.items():
                place = self.layout.blocks.slices(k)
                array[(*place, *(slice(None),) * (array.ndim - len(place)))] = values[name]

    def read(self, k: int) -> dict[str, np.ndarray]:
        """Piece k.

        **Raises:** `FileFormatError` if it is damaged.
        """
        place = self.layout.blocks.slices(k)
        found = {}
        for name, array in self._arrays.items():
            try:
                found[name] = array[(*place, *(slice(None),) * (array.ndim - len(place)))]
            except Exception as error:  # (of many kinds: checksums, sizes, headers)
                raise FileFormatError(
                    f"piece {k} of '{self.address}' is damaged in `{name}`: make the call that "
                    "wrote it again, and it will be run again."
                ) from error
        return found

    def whole(self, name: str) -> np.ndarray:
        """A variable of all pieces."""
        return self._arrays[name][...]

    def constants(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """Those of these constants that there are."""
        return {name: np.asarray(self._group[name][...]) for name in names if name in self._group}

    def discard_damaged(self) -> None:
        """Delete chunks whose checksums are wrong, so that they are missing."""
        from zarr.core.sync import sync

        missing = set(self.missing())
        there = [k for k in range(len(self.layout.blocks)) if k not in missing]
        for k in counted(there, "pieces looked at", len(there)):
            try:
                self.read(k)
            except FileFormatError:
                for x in self._each():
                    sync(x.store.delete(_chunk(x, self._place(x, k))))

    def dataset(self) -> Any:
        """Values are read when they are used."""
        found = package("xarray").open_zarr(self.address, consolidated=False, chunks=None)
        rest = [name for name in found.data_vars if name not in self._arrays]
        found = found[[*self._arrays, *rest]]
        return found.assign_attrs(hybridjax=json.dumps(self.layout.description))

    def _each(self) -> Iterator[Any]:
        return iter(self._arrays.values())

    def _place(self, array: Any, k: int) -> tuple[int, ...]:
        place = self.layout.blocks.place(k)
        return (*place, *(0,) * (array.ndim - len(place)))

    def _there(self, name: str) -> set[int]:
        """The pieces that have a chunk of a variable."""
        from zarr.core.sync import sync

        array, blocks = self._arrays[name], self.layout.blocks
        prefix = f"{array.path}/c/" if array.path else "c/"

        async def listed() -> list[str]:
            return [key async for key in array.store.list_prefix(prefix)]

        found = set()
        for key in sync(listed()):
            parts = key.removeprefix(prefix).split("/")
            if len(parts) == array.ndim and all(map(str.isdecimal, parts)):
                place = tuple(map(int, parts[: len(blocks.shape)]))
                found.add(int(np.ravel_multi_index(place, blocks.counts)))
        return found


def open_store(address: str, description: Mapping[str, Any]) -> ZarrStore | None:
    """A store that holds these results, or a part of them; None if there is nothing. Pieces that
    are damaged are taken out.

    **Raises:** `DefinitionError` if it holds other results, or something else.
    """
    about = _about(address)
    if about is None:
        return None
    found = difference(json.loads(json.dumps(description)), about["description"])
    if found is not None:
        raise DefinitionError(f"'{address}' holds other results: {found}. Choose another store.")
    store = ZarrStore(address)
    store.discard_damaged()
    return store


def make_store(address: str, layout: Layout, start: list[np.ndarray]) -> ZarrStore:
    """A new store. What is in the arrays of `start` is given to those who open it.

    **Raises:** `DefinitionError` if it cannot be written.
    """
    with _writing(address), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # (Zarr says that its format of texts may change.)
        _make(address, layout, start)
    return ZarrStore(address)


def _about(address: str) -> Mapping[str, Any] | None:
    """The description in a store, if there is one.

    **Raises:** `DefinitionError` for something else in its place.
    """
    try:
        group = _group(address, "r")
    except FileNotFoundError:
        if _occupied(address):
            raise DefinitionError(
                f"'{address}' is there, and is no store of results: choose another name."
            ) from None
        return None
    except Exception as error:
        raise DefinitionError(f"cannot open '{address}' as a Zarr store: {error}") from error
    try:
        return json.loads(group.attrs[_ABOUT])
    except (KeyError, TypeError, ValueError) as error:
        raise DefinitionError(
            f"'{address}' was not written by hybridjax, or not to its end: choose another store, "
            "or delete it."
        ) from error


def _occupied(address: str) -> bool:
    return "://" not in address and (
        os.path.isfile(address) or (os.path.isdir(address) and bool(os.listdir(address)))
    )


def _make(address: str, layout: Layout, start: list[np.ndarray]) -> None:
    from zarr.codecs import Crc32cCodec

    common = {"compressors": [Crc32cCodec()], "config": {"write_empty_chunks": True}}
    group = _group(address, "a")

    def constant(where: Any, name: str, x: Constant) -> None:
        values = np.asarray(x.values)
        whole = tuple(max(n, 1) for n in values.shape)
        where.create_array(
            name, data=values, chunks=whole or "auto", dimension_names=x.dims,
            attributes=dict(x.attributes), **common,
        )  # fmt: skip

    for name, x in layout.variables.items():
        group.create_array(
            name, shape=layout.shape(name), chunks=(*layout.blocks.block, *x.shape),
            dtype=x.dtype, fill_value=x.fill, dimension_names=layout.axes(name),
            attributes=dict(x.attributes), **common,
        )  # fmt: skip
    for name, x in layout.constants.items():
        constant(group, name, x)
    kept = group.require_group(_START)
    for i, x in enumerate(start):
        constant(kept, f"{i}", Constant(tuple(f"axis_{j}" for j in range(np.ndim(x))), x))
    beside = [x for x in layout.coordinates if (x,) != layout.constants[x].dims]
    if beside:
        group.attrs["coordinates"] = " ".join(beside)
    about = {
        "description": layout.description,
        "dims": layout.dims,
        "variables": list(layout.variables),
    }
    group.attrs[_ABOUT] = json.dumps(about)  # last: from here on it is a store


def _layout(arrays: Mapping[str, Any], about: Mapping[str, Any]) -> Layout:
    """What `_make` was given, of what varies from point to point."""
    dims = tuple(about["dims"])
    p = len(dims)
    first = next(iter(arrays.values()))
    variables = {
        name: Variable(x.dtype.str, tuple(x.metadata.dimension_names[p:]), x.shape[p:])
        for name, x in arrays.items()
    }
    blocks = Blocks(first.shape[:p], first.chunks[:p])
    return Layout(dims, blocks, variables, {}, (), about["description"])


def _group(address: str, mode: Any) -> Any:
    return package("zarr").open_group(address, mode=mode)


def _chunk(array: Any, place: tuple[int, ...]) -> str:
    name = "/".join(("c", *map(str, place)))
    return f"{array.path}/{name}" if array.path else name


@contextlib.contextmanager
def _writing(address: str):
    """**Raises:** `DefinitionError` where a store cannot be written."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise DefinitionError(f"cannot write to '{address}': {error}") from error
