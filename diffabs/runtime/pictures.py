"""Text inside a PNG file: the numbers that a figure shows travel with the figure.

A `tEXt` chunk is a keyword, a zero, and Latin-1 text. Each chunk is its length, its type, its data and their CRC.

Source: W3C, Portable Network Graphics (third edition), section 11.3.3.
"""

import struct
import zlib
from collections.abc import Iterator

AXES_KEY = "diffabs-axes"  # the keyword of the numbers that a figure shows, as JSON
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER_BYTES = len(PNG_SIGNATURE) + 25  # bytes until after IHDR, which is always the first chunk


def with_text(picture: bytes, key: str, text: str) -> bytes:
    """Return a PNG with an ASCII text under a keyword, or other data unchanged.

    Args:
        picture: Content of the file.
        key: Keyword.
        text: ASCII text.
    """
    if not picture.startswith(PNG_SIGNATURE):
        return picture
    data = b"tEXt" + key.encode("ascii") + b"\0" + text.encode("ascii")
    chunk = struct.pack(">I", len(data) - 4) + data + struct.pack(">I", zlib.crc32(data))
    return picture[:PNG_HEADER_BYTES] + chunk + picture[PNG_HEADER_BYTES:]


def without_text(picture: bytes, key: str) -> tuple[bytes, str]:
    """Return a PNG without the text under a keyword, and that text.

    Without such a text, or for data that is not a whole PNG, the picture is unchanged and the text is empty.

    Args:
        picture: Content of the file.
        key: Keyword.
    """
    keyword = b"tEXt" + key.encode("ascii") + b"\0"
    for start, end in _chunks(picture):
        data = picture[start + 4 : end - 4]
        if data.startswith(keyword):
            return picture[:start] + picture[end:], data[len(keyword) :].decode("latin-1")
    return picture, ""


def _chunks(picture: bytes) -> Iterator[tuple[int, int]]:
    """Yield the first byte of each whole chunk, and the byte after its last."""
    start = len(PNG_SIGNATURE) if picture.startswith(PNG_SIGNATURE) else len(picture)
    while start + 12 <= len(picture):
        end = start + 12 + int.from_bytes(picture[start : start + 4], "big")
        if end > len(picture):
            return
        yield start, end
        start = end
