"""Arrays on disk that are mapped, not copied: an uncompressed `.npz` with checks.

An `.npz` is a zip of `.npy` files, and one that is not compressed holds each array as
it lies in memory. So a reader can map it, and who wants a part of an array reads that
part. Zip keeps a CRC-32 of every member: it is compared on the way in, so that a file
cut short or changed says so. Writing is in order, the last array as long as it comes,
for arrays made piece by piece; the file appears under its name when it is whole.
"""

import io
import os
import struct
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Array

__all__ = ["UNREADABLE", "read_arrays", "write_arrays"]

UNREADABLE = (
    OSError,
    KeyError,
    ValueError,
    TypeError,
    EOFError,
    NotImplementedError,  # of zipfile: a way of compressing that it does not know
    struct.error,  # of a header's lengths, where the file ends too soon
    zipfile.BadZipFile,
)
"""What reading a file that is none of ours, or no more, may raise."""

_NAME_LENGTHS = 26  # where a member's local header tells the lengths of its name
_LOCAL_HEADER = 30  # bytes of it before that name
_LONGEST_HEADER = 1024  # bytes; those of `.npy` are 128


def write_arrays(
    path: Path,
    arrays: Mapping[str, np.ndarray | Array],
    name: str,
    shape: tuple[int, ...],
    dtype: np.dtype,
    pieces: Iterable[np.ndarray],
) -> None:
    """Write arrays, and one more that comes in pieces.

    Args:
        path: the file, replaced if it is there.
        arrays: by name.
        name: of the last one.
        shape: of the last one.
        dtype: of the last one.
        pieces: of the last one, along its first axis.

    Raises:
        ValueError: the pieces together do not have that shape.
    """
    unfinished = path.with_name(path.name + ".part")
    try:
        with zipfile.ZipFile(unfinished, "w") as archive:
            for key, array in arrays.items():
                with archive.open(f"{key}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.asarray(array, order="C"))
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                descr = np.lib.format.dtype_to_descr(dtype)
                header = {"descr": descr, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(file, header)
                rows = 0
                for piece in pieces:
                    file.write(np.ascontiguousarray(piece, dtype).tobytes())
                    rows += len(piece)
        if rows != shape[0]:
            raise ValueError(f"expected {shape[0]} rows of {name}, got {rows}")
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Map the arrays of a file, each after its checksum.

    Raises:
        OSError, ValueError, zipfile.BadZipFile: one of `UNREADABLE`, if it is missing,
            torn, changed, compressed or something else.
    """
    arrays = {}
    with zipfile.ZipFile(path) as archive, path.open("rb") as file:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{entry.filename} is compressed")
            file.seek(entry.header_offset + _NAME_LENGTHS)
            begin = entry.header_offset + _LOCAL_HEADER
            begin += sum(struct.unpack("<HH", file.read(4)))
            whole = np.memmap(path, np.uint8, "r", begin, (entry.file_size,))
            if zlib.crc32(whole.data) != entry.CRC:
                raise ValueError(f"the checksum of {entry.filename} is wrong")
            arrays[entry.filename.removesuffix(".npy")] = _array_in(whole)
    return arrays


def _array_in(whole: np.ndarray) -> np.ndarray:
    """The array of a `.npy` file that lies in memory."""
    head = io.BytesIO(whole[:_LONGEST_HEADER].tobytes())
    np.lib.format.read_magic(head)
    shape, _, dtype = np.lib.format.read_array_header_1_0(head)
    return np.frombuffer(whole, dtype, int(np.prod(shape)), head.tell()).reshape(shape)
