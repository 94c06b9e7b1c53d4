"""A ChArUco board: where its corners are, finding them in an image, and drawing it for a printer.

The board's frame is OpenCV's: the origin in the outer corner of its first square, x along the rows
of squares, y along the columns, z into the board.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from vla_zenoh.types import FloatArray
from vla_zenoh_calibrate.errors import CalibrationError

Grey = NDArray[np.uint8]
DICTIONARIES = tuple(
    f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
)
MIN_CORNERS, MIN_SHARE = 8, 0.3
"""Fewest corners of a board that is not called partial, and the share of all."""
MAX_EDGE_PX = 4.0
"""A sharp edge is 1 to 2.5 pixels wide; it moves a corner when it is wider than this."""
MAX_OFF = 0.15
"""Of a square: how far a corner may be from the plane's image, as lenses bend it."""
MM_PER_INCH, POINTS_PER_INCH = 25.4, 72.0


class Refused(NamedTuple):
    """Why an image was not taken: a stable name as ``blurred``, and the reason in words."""

    reason: str
    why: str


class Corners(NamedTuple):
    """Corners of a board in an image.

    Args:
        ids: (k,) their numbers, row by row.
        pixels: (k, 2) in OpenCV's pixels: (0, 0) is the centre of the first.
        edge_px: width of the board's edges in the image.
    """

    ids: NDArray[np.int32]
    pixels: FloatArray
    edge_px: float


@dataclass(frozen=True)
class Board:
    """A ChArUco board of `columns` by `rows` squares; markers are in the white ones.

    Raises:
        CalibrationError: there is no such board.
    """

    columns: int = 9
    rows: int = 6
    square_m: float = 0.03
    marker_m: float = 0.022
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            known = ", ".join(DICTIONARIES)
            raise CalibrationError(f"no dictionary {self.dictionary!r}; there are: {known}")
        if not (3 <= self.columns <= 50 and 3 <= self.rows <= 50):
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares: wanted are 3 to 50 each way"
            )
        if not 0.002 <= self.square_m <= 1.0:
            raise CalibrationError(f"squares of {self.square_m:g} m: wanted are 0.002 to 1 m")
        if not 0.3 * self.square_m <= self.marker_m <= 0.9 * self.square_m:
            raise CalibrationError(
                f"markers of {self.marker_m:g} m in squares of {self.square_m:g} m: wanted are "
                "0.3 to 0.9 of the square"
            )
        markers, most = self.columns * self.rows // 2, int(self.dictionary.partition("_")[2])
        if markers > most:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} squares needs {markers} markers, and "
                f"dictionary {self.dictionary} has {most}: take a larger one"
            )

    @property
    def written(self) -> str:
        """The board in words, as in messages."""
        return (
            f"{self.columns}x{self.rows} squares of {self.square_m * 1e3:g} mm, "
            f"markers of {self.marker_m * 1e3:g} mm of {self.dictionary}"
        )

    @cached_property
    def _board(self) -> Any:
        size = (self.columns, self.rows)
        words = _dictionary(self.dictionary)
        return cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, words)

    @cached_property
    def _detector(self) -> Any:
        return cv2.aruco.CharucoDetector(self._board)

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of all squares."""
        return self.columns * self.square_m, self.rows * self.square_m

    @cached_property
    def points_m(self) -> FloatArray:
        """(n, 3) inner corners in the board's frame, row by row."""
        return np.asarray(self._board.getChessboardCorners(), np.float64)

    # -- finding it ---------------------------------------------------------------------------
    def find(self, grey: Grey) -> Corners | Refused:
        """The board in an image (H, W) uint8, or why it is of no use there."""
        found, ids, _, markers = self._detector.detectBoard(grey)
        if ids is None or markers is None or len(ids) == 0:
            return Refused("no_board", f"no board of {self.written} is seen")
        wanted = max(MIN_CORNERS, round(MIN_SHARE * len(self.points_m)))
        if len(ids) < wanted:
            why = f"{len(ids)} of {len(self.points_m)} corners are seen, wanted are {wanted}"
            return Refused("partial", why)
        numbers = np.asarray(ids, np.int32).ravel()
        pixels = np.asarray(found, np.float64).reshape(-1, 2)
        order = np.argsort(numbers)
        numbers, pixels = numbers[order], pixels[order]
        if self._off(numbers, pixels) > MAX_OFF:
            why = f"corners are not where a board of {self.written} has them: count its squares"
            return Refused("other_board", why)
        edge_px = self._edge_px(grey, numbers, pixels)
        if edge_px > MAX_EDGE_PX:
            why = f"edges are {edge_px:.1f} pixels wide, at most {MAX_EDGE_PX:g} are sharp"
            return Refused("blurred", why)
        return Corners(numbers, pixels, edge_px)

    def why_not(self, grey: Grey) -> str:
        """Why no board is found in an image: it is mirrored, or shows markers of others."""
        if not isinstance(self.find(np.ascontiguousarray(grey[:, ::-1])), Refused):
            return (
                "the image is mirrored: a mirrored camera has no place in space; take its flip "
                "out, also in the camera's own settings"
            )
        best, most, last = "", 0, 0
        for name in DICTIONARIES:
            if not name.endswith("1000"):  # the larger ones begin with the smaller ones
                continue
            ids = cv2.aruco.ArucoDetector(_dictionary(name)).detectMarkers(grey)[1]
            numbers = [] if ids is None else np.asarray(ids).ravel()
            if len(numbers) > most:
                best, most, last = name, len(numbers), int(max(numbers))
        own = self.dictionary.partition("_")[0]
        if most < 3:
            return f"no board of {self.written} and no markers at all are seen"
        theirs = best.partition("_")[0]
        if theirs != own:
            return f"no board of {self.written}; there are {most} markers of {theirs}"
        mine = self.columns * self.rows // 2
        return (
            f"no board of {self.written}; {most} markers of {theirs} up to number {last} are "
            f"seen, this board has 0 to {mine - 1}: are columns, rows or the sizes others?"
        )

    def _off(self, ids: NDArray[np.int32], pixels: FloatArray) -> float:
        """Distance of the worst corner from the image of a plane, in squares."""
        flat = self.points_m[ids, :2]
        plane, _ = cv2.findHomography(flat, pixels)
        if plane is None:
            return np.inf
        there = cv2.perspectiveTransform(flat[None], plane)[0]
        return float(np.abs(there - pixels).max() / self._square_px(ids, pixels))

    def _pairs(self, ids: NDArray[np.int32]) -> tuple[list[tuple[int, int]], ...]:
        """Places in `ids` of corners beside each other along the rows, and along the columns."""
        places, across = {int(one): place for place, one in enumerate(ids)}, self.columns - 1
        rows = [
            (place, places[one + 1])
            for one, place in places.items()
            if one + 1 in places and one // across == (one + 1) // across
        ]
        columns = [
            (place, places[one + across]) for one, place in places.items() if one + across in places
        ]
        return rows, columns

    def _square_px(self, ids: NDArray[np.int32], pixels: FloatArray) -> float:
        first, last = np.array([pair for way in self._pairs(ids) for pair in way] or [(0, 1)]).T
        return float(np.median(np.linalg.norm(pixels[last] - pixels[first], axis=1)))

    def _edge_px(self, grey: Grey, ids: NDArray[np.int32], pixels: FloatArray) -> float:
        """Width of edges: contrast over slope, of the blurrier of both directions."""
        left, top = np.floor(pixels.min(axis=0)).astype(int).clip(0)
        right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + 1
        low, high = np.percentile(grey[top:bottom, left:right], (5, 95))
        contrast = max(float(high - low), 1.0)
        steps = np.arange(-2.0, 2.01, 0.5)
        widths = [0.0]
        for way in self._pairs(ids):
            if not way:
                continue
            first, last = np.array(way).T
            along = pixels[last] - pixels[first]
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            normal = np.column_stack([-along[:, 1], along[:, 0]])
            middle = (pixels[first] + pixels[last]) / 2
            places = (middle[:, None] + steps[:, None] * normal[:, None]).astype(np.float32)
            values = cv2.remap(grey, places[..., 0], places[..., 1], cv2.INTER_LINEAR)
            # Over a whole pixel: what is below that is interpolated.
            slope = np.abs(values[:, 2:].astype(float) - values[:, :-2]).max(axis=1)
            widths.append(float(np.median(contrast / np.maximum(slope, 1e-3))))
        return max(widths)

    # -- printing it --------------------------------------------------------------------------
    def image(self, pixels_per_square: int, margin_squares: float = 0.0) -> Grey:
        """The board, (H, W) uint8, with a white margin around it."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        drawn = np.asarray(self._board.generateImage(size, marginSize=0), np.uint8)
        margin = round(margin_squares * pixels_per_square)
        return np.pad(drawn, margin, constant_values=255)

    def png(self, dpi: int = 300) -> bytes:
        """The board as a PNG file that says its size in print."""
        per_square = max(8, round(self.square_m * 1e3 / MM_PER_INCH * dpi))
        drawn = self.image(per_square, margin_squares=0.5)
        data = cv2.imencode(".png", drawn)[1].tobytes()
        # Pixels are whole, so that the file has the resolution at which a square is exact.
        per_metre = round(per_square / self.square_m)
        body = b"pHYs" + per_metre.to_bytes(4, "big") * 2 + b"\x01"
        chunk = (9).to_bytes(4, "big") + body + zlib.crc32(body).to_bytes(4, "big")
        after_header = 8 + 25
        return data[:after_header] + chunk + data[after_header:]

    def pdf(self) -> bytes:
        """The board as a PDF page of its own size plus a margin, each square of true size."""
        per_square = 32 * round(self.square_m / self.marker_m * 4)
        drawn = self.image(per_square)
        height, width = drawn.shape
        across, down = (side * 1e3 / MM_PER_INCH * POINTS_PER_INCH for side in self.size_m)
        margin = 12 / MM_PER_INCH * POINTS_PER_INCH
        text = f"ChArUco {self.written}. Print at 100 %, then measure a square."
        words = text.encode("ascii", "replace")
        content = (
            f"q {across:.4f} 0 0 {down:.4f} {margin:.4f} {margin:.4f} cm /Board Do Q\n"
            f"BT /Font 8 Tf {margin:.2f} {margin / 3:.2f} Td (".encode()
            + words
            + b") Tj ET"
        )
        picture = zlib.compress(drawn.tobytes(), 9)
        box = f"[0 0 {across + 2 * margin:.4f} {down + 2 * margin:.4f}]"
        return _pdf(
            [
                b"<< /Type /Catalog /Pages 2 0 R >>",
                b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
                f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R /Resources "
                "<< /XObject << /Board 5 0 R >> /Font << /Font 6 0 R >> >> >>".encode(),
                _stream(b"", content),
                _stream(
                    f"/Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace "
                    "/DeviceGray /BitsPerComponent 8 /Filter /FlateDecode ".encode(),
                    picture,
                ),
                b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
            ]
        )


def _dictionary(name: str) -> Any:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _stream(about: bytes, data: bytes) -> bytes:
    return b"<< %s/Length %d >>\nstream\n%s\nendstream" % (about, len(data), data)


def _pdf(objects: list[bytes]) -> bytes:
    """A PDF file of these objects, the catalogue first."""
    out, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    began = len(out)
    count = len(objects) + 1
    out += b"xref\n0 %d\n0000000000 65535 f \n" % count
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    return out + b"trailer << /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (count, began)
