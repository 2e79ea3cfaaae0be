"""The peers: what a user could store heights with instead.

A `Codec` turns a `Piece` (a whole raster, or one tile of it) into bytes at a tolerance, and the bytes back
into heights with the peer's own decoder. Integer codecs are given the raster quantised in steps of the
largest size that keeps the error: 2 E, or the odd number of source units if that is larger (2 E + 1 for
whole metres). The rounding is ours to do; the coding is theirs, lossless.
"""

from collections.abc import Callable
from dataclasses import dataclass

import imagecodecs as ic
import numpy as np


@dataclass(frozen=True)
class Scale:
    """How a raster becomes integers at an error: known once per layer, so no piece pays for it."""

    error: float
    # Metres of the source's own unit if all heights are multiples of it, else 0.
    unit: float
    # Metres of a step of the quantised raster, of a height in the middle of a step, and its smallest value.
    step: float
    base: float
    low: int
    # The smallest height in source units.
    unit_low: int

    @staticmethod
    def of(heights: np.ndarray, unit: float, error: float, phase: str = "zero") -> "Scale":
        """For a raster with NaN where there is nothing. Steps have their middle at height 0, or at the
        `lowest` height: by chance the one or the other costs a hundredth less."""
        step, unit_low = 2.0 * error, 0
        if unit > 0:
            # 1e-9: 0.3 / 0.1 must give 3.
            step = max(step, (2 * np.floor(error / unit + 1e-9) + 1) * unit)
            unit_low = int(np.rint(np.nanmin(heights) / unit))
        base = float(np.nanmin(heights)) if phase == "lowest" else 0.0
        return Scale(error, unit, step, base, int(np.rint((np.nanmin(heights) - base) / step)), unit_low)


@dataclass(frozen=True)
class Piece:
    """Heights without holes, which of them count, and the scale."""

    heights: np.ndarray
    valid: np.ndarray
    scale: Scale

    def steps(self) -> np.ndarray:
        """The quantised raster from 0 up, in one byte or two."""
        steps = np.rint((self.heights - self.scale.base) / self.scale.step).astype(np.int64) - self.scale.low
        # What is clipped would be found when the decoded heights are compared.
        return np.clip(steps, 0, 65535).astype(np.uint8 if steps.max() < 256 else np.uint16)

    def units(self) -> np.ndarray:
        """The heights in source units from 0 up."""
        return np.rint(self.heights / self.scale.unit).astype(np.int64) - self.scale.unit_low


@dataclass(frozen=True)
class Codec:
    """A peer with its best settings. `encode(piece, tolerance)` and `decode(bytes, piece)`, which may use the
    piece's shape and scale only."""

    name: str
    # What `figures` are kept under: parameters and version.
    key: str
    encode: Callable[[Piece, float], bytes]
    decode: Callable[[bytes, Piece], np.ndarray]
    # Factors on E to try, the first that holds for every sample counts. Integer codecs need no choice.
    factors: tuple[float, ...] = (1.0,)
    holes: bool = False
    # How slow it is: 0 seconds, 1 half a minute, 2 as much and many variants, for a million samples.
    cost: int = 0
    # What of `decode` is the peer's own work, for timing; the whole of it if there is none.
    raw: Callable[[bytes, Piece], object] | None = None
    # Whether it needs heights that are multiples of a unit.
    needs_unit: bool = False
    # Where the middle of a step may lie; the best counts.
    phases: tuple[str, ...] = ("zero",)
    # On the first DEMs only.
    few: bool = False


# Where an encoder breaks its own bound by rounding, a hair less will do; where by design, much less.
TIGHTER = (1.0, 0.9999, 0.999, 0.99, 0.97, 0.94, 0.9, 0.8, 0.7, 0.5, 0.25)


def _stepwise(name: str, key: str, encode: Callable, decode: Callable, **more) -> Codec:
    """A lossless codec of the quantised raster."""

    def back(data: bytes, piece: Piece) -> np.ndarray:
        steps = decode(data, piece.heights.shape)
        return (steps.astype(np.int64) + piece.scale.low) * piece.scale.step + piece.scale.base

    def raw(data: bytes, piece: Piece) -> np.ndarray:
        return decode(data, piece.heights.shape)

    return Codec(name, key, lambda piece, _: encode(piece.steps()), back, raw=raw, **more)


def _floating(name: str, key: str, encode: Callable, decode: Callable, **more) -> list[Codec]:
    """A codec of floats with a tolerance; and, since whole units survive another half of one, the same with
    that much more and its result rounded."""

    def plain(piece: Piece, tolerance: float) -> bytes:
        return encode(piece.heights.astype(np.float32), tolerance)

    def plain_back(data: bytes, piece: Piece) -> np.ndarray:
        return decode(data, piece.heights.shape).astype(np.float64)

    def units(piece: Piece, tolerance: float) -> bytes:
        # Of E and half a unit, a hair is left for the encoder's own rounding.
        whole = np.floor(piece.scale.error / piece.scale.unit + 1e-9)
        return encode(piece.units().astype(np.float32), (whole + 0.49) * tolerance / piece.scale.error)

    def units_back(data: bytes, piece: Piece) -> np.ndarray:
        units = np.rint(decode(data, piece.heights.shape).astype(np.float64))
        return (units + piece.scale.unit_low) * piece.scale.unit

    def raw(data: bytes, piece: Piece) -> np.ndarray:
        return decode(data, piece.heights.shape)

    more = {"factors": TIGHTER, "raw": raw} | more
    return [
        Codec(name, key, plain, plain_back, **more),
        Codec(f"{name}, rounded", f"{key} rounded", units, units_back, needs_unit=True, **more),
    ]


def _lerc(zstd: bool) -> Codec:
    """LERC of whole units or of floats; it has a mask of its own."""
    extra = {"compression": "zstd", "compressionargs": {"level": 22}} if zstd else {}

    def encode(piece: Piece, tolerance: float) -> bytes:
        masks = None if piece.valid.all() else piece.valid
        if piece.scale.unit > 0:
            units = piece.units().astype(np.int32)
            return ic.lerc_encode(units, level=tolerance / piece.scale.unit, masks=masks, **extra)
        return ic.lerc_encode(piece.heights.astype(np.float32), level=tolerance, masks=masks, **extra)

    def decode(data: bytes, piece: Piece) -> np.ndarray:
        heights = ic.lerc_decode(data).astype(np.float64)
        unit = piece.scale.unit
        return (heights + piece.scale.unit_low) * unit if unit > 0 else heights

    name = "LERC + zstd" if zstd else "LERC"
    return Codec(name, f"lerc {extra}", encode, decode, factors=TIGHTER, holes=True)


def _jpegls_near() -> Codec:
    """JPEG-LS with NEAR, which is at most 255."""

    def encode(piece: Piece, tolerance: float) -> bytes:
        near = int(tolerance / piece.scale.unit + 1e-9)
        units = piece.units()
        if near > 255 or units.max() > 65535:
            raise ValueError("NEAR is at most 255, heights have at most 16 bits")
        return ic.jpegls_encode(units.astype(np.uint16), level=near)

    def decode(data: bytes, piece: Piece) -> np.ndarray:
        return (ic.jpegls_decode(data).astype(np.int64) + piece.scale.unit_low) * piece.scale.unit

    return Codec("JPEG-LS near-lossless", "jpegls near", encode, decode, needs_unit=True)


def _residual(steps: np.ndarray) -> np.ndarray:
    """W + N - NW; zero outside."""
    a = np.pad(steps.astype(np.int32), ((1, 0), (1, 0)))
    return a[1:, 1:] - a[1:, :-1] - a[:-1, 1:] + a[:-1, :-1]


def _pcodec() -> Codec:
    def encode(steps: np.ndarray) -> bytes:
        residual = _residual(steps)
        # One place has the whole height; two bytes where they do, as a user would choose.
        wide = bool(np.abs(residual).max() > 32767)
        return bytes([wide]) + ic.pcodec_encode(
            residual.astype(np.int32 if wide else np.int16).ravel(), level=12
        )

    def decode(data: bytes, shape: tuple[int, int]) -> np.ndarray:
        kind = np.int32 if data[0] else np.int16
        flat = ic.pcodec_decode(data[1:], (shape[0] * shape[1],), kind)
        return flat.reshape(shape).astype(np.int64).cumsum(0).cumsum(1)

    return _stepwise("pcodec of W+N-NW", "pcodec 12", encode, decode)


def _zstd_predictor() -> Codec:
    """What a block of a GeoTIFF with ZSTD and predictor 2 holds, without the file around it."""

    def encode(steps: np.ndarray) -> bytes:
        delta = np.diff(steps, axis=1, prepend=np.zeros((steps.shape[0], 1), steps.dtype))
        return ic.zstd_encode(delta.tobytes(), level=22)

    def decode(data: bytes, shape: tuple[int, int]) -> np.ndarray:
        delta = ic.zstd_decode(data)
        kind = np.uint8 if len(delta) == shape[0] * shape[1] else np.uint16
        return np.frombuffer(delta, kind).reshape(shape).cumsum(1, dtype=kind)

    return _stepwise("GeoTIFF ZSTD, predictor 2", "zstd 22 predictor 2", encode, decode)


def _rgb(values: np.ndarray) -> np.ndarray:
    return np.stack([values >> 16, values >> 8 & 255, values & 255], axis=-1).astype(np.uint8)


def _grey(rgb: np.ndarray) -> np.ndarray:
    rgb = rgb[..., :3].astype(np.int64)
    return rgb[..., 0] << 16 | rgb[..., 1] << 8 | rgb[..., 2]


def _webp(rgb: np.ndarray) -> bytes:
    return ic.webp_encode(rgb, level=100, lossless=True, method=6, numthreads=1)


def _png(rgb: np.ndarray) -> bytes:
    return ic.png_encode(rgb, level=9)


def _terrain_rgb(image: str, interval: str) -> Codec:
    """Heights in the colours of a picture. `own`: a value is a step of the quantised raster. `mapbox`: tenths
    of a metre above -10 km, heights rounded to whole steps. `power`: the same, but the steps are the largest
    power of two of tenths within the error, so that low bits are all zero."""
    to, back = (_webp, ic.webp_decode) if image == "WebP" else (_png, ic.png_decode)
    cost = 2 if image == "WebP" else 0
    if interval == "own":
        return _stepwise(
            f"{image} terrain-rgb, own interval",
            f"{image} 100 6 own",
            lambda s: to(_rgb(s.astype(np.int64))),
            lambda data, _: _grey(back(data)),
            cost=cost,
            few=image == "PNG",
        )

    def step(scale: Scale) -> float:
        if interval == "mapbox":
            return max(np.floor(scale.step * 10 + 1e-6), 1) / 10
        return 2.0 ** np.floor(np.log2(max(20 * scale.error, 1))) / 10

    def encode(piece: Piece, _: float) -> bytes:
        size = step(piece.scale)
        tenths = np.rint(np.rint(piece.heights / size) * size * 10).astype(np.int64)
        base = 100_000 if interval == "mapbox" else 100_000 - 100_000 % round(size * 10)
        return to(_rgb(tenths + base))

    def decode(data: bytes, piece: Piece) -> np.ndarray:
        base = 100_000 if interval == "mapbox" else 100_000 - 100_000 % round(step(piece.scale) * 10)
        return (_grey(back(data)) - base) / 10

    label = "Mapbox encoding" if interval == "mapbox" else "Mapbox, steps of 2^k"
    return Codec(
        f"{image} terrain-rgb, {label}", f"{image} 100 6 {interval}", encode, decode, cost=cost, few=True
    )


def _jxl(effort: int) -> Codec:
    def encode(steps: np.ndarray) -> bytes:
        return ic.jpegxl_encode(steps, lossless=True, effort=effort, usecontainer=False, numthreads=1)

    cost = 1 if effort > 3 else 0
    phases = ("zero", "lowest") if effort > 3 else ("zero",)
    return _stepwise(
        f"JPEG XL effort {effort}",
        f"jxl {effort} {' '.join(phases)}",
        encode,
        lambda data, _: ic.jpegxl_decode(data, numthreads=1),
        cost=cost,
        phases=phases,
    )


def _j2k(steps: np.ndarray) -> bytes:
    # As many halvings as a small tile allows.
    halvings = min(6, max(1, int(np.log2(min(steps.shape)))))
    return ic.jpeg2k_encode(
        steps, level=0, reversible=True, codecformat="j2k", resolutions=halvings, numthreads=1
    )


def mask_bytes(valid: np.ndarray) -> bytes:
    """The smaller of two ways to store which samples have a height; decoded and compared."""
    packed = ic.zstd_encode(np.packbits(valid, axis=1).tobytes(), level=22)
    image = valid.astype(np.uint8)
    xl = ic.jpegxl_encode(image, lossless=True, effort=9, usecontainer=False, numthreads=1)
    if not np.array_equal(ic.jpegxl_decode(xl), image):
        raise ValueError("a mask did not come back")
    return min(packed, xl, key=len)


CODECS: list[Codec] = [
    _lerc(zstd=False),
    _lerc(zstd=True),
    _jpegls_near(),
    _stepwise(
        "JPEG-LS", "jpegls 0", lambda s: ic.jpegls_encode(s, level=0), lambda data, _: ic.jpegls_decode(data)
    ),
    _jxl(3),
    _jxl(9),
    *_floating(
        "SZ3",
        "sz3 abs",
        lambda a, e: ic.sz3_encode(a, mode="abs", abs=e),
        lambda data, shape: ic.sz3_decode(data, shape, np.float32),
    ),
    *_floating(
        "SPERR",
        "sperr pwe",
        lambda a, e: ic.sperr_encode(a, level=e, mode="pwe", numthreads=1),
        lambda data, _: ic.sperr_decode(data, numthreads=1),
    ),
    # Its true error is far below its tolerance, so the largest tolerance that holds is sought from above.
    *_floating(
        "zfp",
        "zfp accuracy",
        lambda a, e: ic.zfp_encode(a, level=e, mode="a", numthreads=1),
        lambda data, _: ic.zfp_decode(data),
        factors=(8.0, 4.0, 2.0, *TIGHTER),
    ),
    _pcodec(),
    _stepwise("JPEG 2000", "j2k reversible", _j2k, lambda data, _: ic.jpeg2k_decode(data)),
    _stepwise(
        "HTJ2K",
        "htj2k reversible",
        lambda s: ic.htj2k_encode(s, reversible=True),
        lambda data, _: ic.htj2k_decode(data),
    ),
    _zstd_predictor(),
    _terrain_rgb("WebP", "own"),
    _terrain_rgb("WebP", "mapbox"),
    _terrain_rgb("WebP", "power"),
    _terrain_rgb("PNG", "own"),
    _terrain_rgb("PNG", "mapbox"),
    _terrain_rgb("PNG", "power"),
]
