"""How much memory the arrays of a MATLAB file of version 5 need, from their headers alone.

`arrays.py` sums the sizes from `declared` before scipy reads the file, so that a damaged or
malicious file is refused before memory is taken.

A file is a list of elements: a tag (type, bytes) and its data. Arrays are elements that begin with
their flags, sizes and names; members of structs and cells are arrays in them. A compressed element
holds one array (MAT-File Format, The MathWorks 2020, Ch. 1).

If a good file is refused, look at `_array`, which reads the headers of all members, and at
`_MEMBER`; if a large one is not refused, at `check_declared` in `columns.py`, which has the limit.
All other numbers below, but `_PIECE`, are those of the format and must not be changed.
"""

import math
import struct
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple, Protocol

from ..._core import limits
from ...errors import FileFormatError, HybridJaxError


_HEADER = 128
_MATRIX = 14
_COMPRESSED = 15
_CELL = 1
_STRUCT = 2
_OBJECT = 3
# Classes of arrays: text, double, single, and whole numbers of 8 to 64 bits.
_TEXT_AND_NUMBERS = (4, *range(6, 16))
# Number of bytes that an empty member counts. Smaller: small files of millions of empty members
# take minutes and memory. Larger: files with many small arrays are refused.
_MEMBER = 1024
# Number of bytes that are decompressed at once. Smaller: more calls. Larger: memory is taken before
# sizes are known.
_PIECE = 2**16


class _Tag(NamedTuple):
    kind: int
    size: int
    """Bytes of the data."""
    data: bytes
    """The data of a small element, which stand in its tag."""


class _Inflated:
    """The content of a compressed element, piece by piece."""

    def __init__(self, file: BinaryIO, size: int):
        self.file = file
        self.left = size
        self.stream = zlib.decompressobj()
        self.ready = b""

    def read(self, size: int) -> bytes:
        while len(self.ready) < size and not self.stream.eof:
            packed = self.stream.unconsumed_tail
            if not packed:
                packed = self.file.read(min(_PIECE, self.left))
                self.left -= len(packed)
            if not packed:
                break
            self.ready += self.stream.decompress(packed, _PIECE)
        content = self.ready[:size]
        self.ready = self.ready[size:]
        return content


class _Source(Protocol):
    def read(self, size: int, /) -> bytes: ...


class _Reader:
    """Tags and data in the next bytes of a source, with the byte order of the file."""

    def __init__(self, source: _Source, order: str, size: int):
        self.source = source
        self.order = order
        self.left = size

    def read(self, size: int, /) -> bytes:
        content = self.source.read(min(size, self.left))
        self.left -= len(content)
        if len(content) < size:
            raise EOFError("it ends within an array")
        return content

    def skip(self, size: int) -> None:
        while size > 0:
            size -= len(self.read(min(size, _PIECE)))

    def tag(self) -> _Tag:
        first = self.read(4)
        second = self.read(4)
        (word,) = struct.unpack(f"{self.order}I", first)
        if word >> 16:  # the number of bytes and the type in one word, then the data
            return _Tag(word & 0xFFFF, word >> 16, second[: word >> 16])
        return _Tag(word, struct.unpack(f"{self.order}I", second)[0], b"")

    def element(self) -> bytes:
        """The data of a short element."""
        tag = self.tag()
        if tag.data:
            return tag.data
        if tag.size > limits.TEXT:
            raise ValueError("a header is too long")
        content = self.read(tag.size)
        self.skip(-tag.size % 8)
        return content

    def integers(self) -> tuple[int, ...]:
        content = self.element()
        return struct.unpack(f"{self.order}{len(content) // 4}i", content)


def declared(path: Path) -> Iterator[int]:
    """Yield the bytes that arrays of numbers, cells and structs take in memory, array by array.

    Nothing larger than a header is kept, so that a caller can stop at a limit.

    **Raises:** `FileFormatError` for a damaged file, and arrays in more than `limits.NESTED`
    structs.
    """
    with open(path, "rb") as file:
        order = ">" if file.read(_HEADER)[-2:] == b"MI" else "<"
        while len(start := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", start)
            end = file.tell() + size
            if kind != _COMPRESSED:  # no larger than it declares
                yield size
                file.seek(end)
                continue
            source = _Reader(_Inflated(file, size), order, sys.maxsize)
            try:
                kind, size, _ = source.tag()
                if kind == _MATRIX:
                    yield from _array(path, source, size, 0)
            except HybridJaxError:
                raise
            except (
                EOFError,
                ValueError,
                IndexError,
                struct.error,
                zlib.error,
            ) as error:
                raise FileFormatError(
                    f"'{path}' is no MATLAB file, or damaged ({error})."
                ) from error
            file.seek(end)


def _array(path: Path, source: _Reader, size: int, depth: int) -> Iterator[int]:
    """Yield the sizes of an array and of its members. (The tag of the array has been read
    already.)"""
    if depth > limits.NESTED:
        raise FileFormatError(
            f"'{path}' has arrays in more than {limits.NESTED} structs or cells: save them in "
            "fewer."
        )
    if not size:  # an empty member
        return
    body = _Reader(source, source.order, size)
    flags = body.integers()[0]
    kind = flags & 0xFF
    is_complex = bool(flags >> 11 & 1)
    of_members = kind in (_CELL, _STRUCT, _OBJECT)
    if not (of_members or kind in _TEXT_AND_NUMBERS):  # sparse arrays, functions
        yield size
        body.skip(body.left)
        return
    count = math.prod(body.integers())
    body.element()  # the name
    if not of_members:
        yield count * (16 if is_complex else 8)
        body.skip(body.left)
        return
    if kind == _OBJECT:
        body.element()  # the name of the class
    fields = 1
    if kind != _CELL:
        (longest,) = body.integers()
        fields = len(body.element()) // max(longest, 1)
    yield fields * count * _MEMBER
    for _ in range(fields * count):
        tag = body.tag()
        if tag.kind != _MATRIX:
            raise ValueError("a member is no array")
        yield from _array(path, body, tag.size, depth + 1)
    body.skip(body.left)
