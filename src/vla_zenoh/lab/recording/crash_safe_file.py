"""An MCAP file that is complete after every write, even if the program is killed.

MCAP is written in chunks. After each chunk come the few bytes that end a file, and the next chunk
overwrites them. So any tool opens the file of a killed writer, up to the last chunk.
"""

from __future__ import annotations

import os
from io import BytesIO
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC

from vla_zenoh.errors import RecordingError


def _end() -> bytes:
    builder = RecordBuilder()
    DataEnd(0).write(builder)
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    return builder.end() + MCAP0_MAGIC


END = _end()
"""What ends an MCAP file without a summary."""


class CrashSafeFile:
    """Output stream of the MCAP writer: kept in memory until `commit`.

    Args:
        path: of the file, which must not exist or be empty.

    Raises:
        RecordingError: the file exists or cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._waiting, self._done = path, BytesIO(), 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT, 0o644)
        except OSError as error:
            raise RecordingError(f"{path} cannot be written: {error.strerror}") from error
        if os.fstat(self._file).st_size:
            self.close()
            raise RecordingError(f"{path} exists and is not overwritten")

    # -- for the MCAP writer ------------------------------------------------------------------
    def write(self, data: bytes) -> int:
        """Keep `data` until `commit`."""
        return self._waiting.write(data)

    def tell(self) -> int:
        """Position in the file after `commit`."""
        return self._done + self._waiting.tell()

    def flush(self) -> None:
        """Do nothing; `commit` writes."""

    # -- for us -------------------------------------------------------------------------------
    @property
    def size(self) -> int:
        """Size of the file on disk, in bytes."""
        return self._done + len(END)

    @property
    def waiting(self) -> int:
        """Number of bytes that `commit` would write."""
        return self._waiting.tell()

    def commit(self, *, last: bool = False) -> None:
        """Write the bytes so far. If they do not fit, the file stays as it was.

        Args:
            last: the MCAP writer has already written the end of the file.

        Raises:
            RecordingError: the disk is full, or broken.
        """
        data = self._waiting.getvalue()
        self._waiting = BytesIO()
        try:
            self._put(data if last else data + END)
        except OSError as error:
            self._put_end_again()
            raise RecordingError(
                f"{self._path}: {error.strerror}; what was recorded until then is whole "
                f"({self.size / 1e6:.1f} MB)"
            ) from error
        self._done += len(data) - (len(END) if last else 0)

    def _put(self, data: bytes) -> None:
        written = 0
        while written < len(data):
            written += os.pwrite(self._file, data[written:], self._done + written)

    def _put_end_again(self) -> None:
        if self._done:  # the bytes were there before: no room is needed
            os.pwrite(self._file, END, self._done)
            os.ftruncate(self._file, self._done + len(END))

    def close(self) -> None:
        """Close the file; bytes since the last `commit` are lost. Closing twice does nothing."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
