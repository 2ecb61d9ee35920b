"""From the bytes of a text file to its lines."""

import codecs
from pathlib import Path

from ....errors import FileFormatError


# Bytes that no text holds, in whatever encoding with one byte for each ASCII character.
_CONTROL = bytes(set(range(32)) - set(b"\t\n\v\f\r\x1a\x1b"))
_COMMENTS = ("#", "%", "//")


def read_lines(path: Path) -> list[str]:
    """The lines of a file in UTF-8, UTF-16 with a byte order mark, or else Latin-1, with the line
    ends of any system.

    **Raises:** `FileFormatError` for what is no text.
    """
    data = path.read_bytes()
    utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if not utf_16 and len(data.translate(None, _CONTROL)) < len(data):
        raise FileFormatError(f"'{path}' is not a text file.")
    try:
        text = data.decode("utf-16" if utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        if utf_16:
            raise FileFormatError(f"'{path}' is not a text file.") from error
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def uncommented(line: str) -> str:
    """The text of a comment."""
    return line.lstrip().lstrip("#%/").strip()
