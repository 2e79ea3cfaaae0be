"""What a peer needs for a DEM at an error: bytes, with the bound verified by decoding; kept on disk.

Figures are kept under hashes of the file, the peer's parameters and version, so that a run after a change
of our own codec only measures ours.
"""

import hashlib
import itertools
import json
import time
from pathlib import Path

import imagecodecs as ic
import numpy as np

from coders import Codec, Piece, Scale, mask_bytes
from dems import Dem

LAYOUTS = {"whole": None, "256": 256, "64": 64}
# Part of every key: count up when the way of measuring changes.
METHOD = 1


class Cache:
    """Figures by key, a line of JSON each; lines are only ever appended."""

    def __init__(self, path: Path):
        self.path = path
        self.figures: dict[str, dict] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            for line in path.read_text().splitlines():
                # A line cut short by a kill is measured again.
                try:
                    entry = json.loads(line)
                    self.figures[entry["key"]] = entry["figure"]
                except (ValueError, KeyError):
                    continue

    def get(self, *parts) -> dict | None:
        return self.figures.get(self._key(parts))

    def put(self, figure: dict, *parts) -> dict:
        key = self._key(parts)
        self.figures[key] = figure
        with open(self.path, "a") as file:
            file.write(json.dumps({"key": key, "of": [str(part) for part in parts], "figure": figure}) + "\n")
        return figure

    @staticmethod
    def _key(parts) -> str:
        return hashlib.sha256(repr((METHOD, ic.__version__, *parts)).encode()).hexdigest()[:24]


def windows(shape: tuple[int, int], side: int | None) -> list[tuple[slice, slice]]:
    """The tiles of a layout: of about `side` samples, all nearly equal, so that no peer pays for slivers."""

    def edges(n: int) -> list[slice]:
        count = max(1, round(n / side)) if side else 1
        at = np.rint(np.linspace(0, n, count + 1)).astype(int)
        return [slice(a, b) for a, b in zip(at, at[1:])]

    return [(rows, columns) for rows in edges(shape[0]) for columns in edges(shape[1])]


def masks(cache: Cache, dem: Dem, layout: str) -> int:
    """Bytes to tell a codec that knows no holes where they are. Full and empty tiles cost nothing."""
    known = cache.get(dem.hash, "masks", layout)
    if known is None:
        total = 0
        for window in windows(dem.heights.shape, LAYOUTS[layout]):
            valid = dem.valid[window]
            if valid.any() and not valid.all():
                total += len(mask_bytes(valid))
        known = cache.put({"bytes": total}, dem.hash, "masks", layout)
    return known["bytes"]


def peer(
    cache: Cache, dem: Dem, codec: Codec, error: float, unit: float, layout: str, fetch_only: bool
) -> dict | None:
    """The figure of a peer: the fewest bytes among the ways of filling holes. `None` if not kept and
    `fetch_only`; a figure without `bytes` says in `why` why there is none."""
    where = (dem.hash, codec.key, repr(error), repr(unit), layout)
    known = cache.get(*where)
    if known is None and not fetch_only:
        known = cache.put(_measure(cache, dem, codec, error, unit, layout), *where)
    return known


def _measure(cache: Cache, dem: Dem, codec: Codec, error: float, unit: float, layout: str) -> dict:
    if codec.needs_unit and unit <= 0:
        return {"why": "heights are not multiples of a unit"}
    best = None
    ways = ["smooth"] if codec.holes else dem.fills
    for way, phase in itertools.product(ways, codec.phases):
        figure = _search(dem, codec, Scale.of(dem.heights, unit, error, phase), layout, way)
        if best is None or figure.get("bytes", np.inf) < best.get("bytes", np.inf):
            best = figure
    if "bytes" in best and not codec.holes:
        best["mask_bytes"] = masks(cache, dem, layout)
        best["bytes"] += best["mask_bytes"]
    return best


def _search(dem: Dem, codec: Codec, scale: Scale, layout: str, way: str) -> dict:
    """The first factor on the error at which no sample is further off."""
    asked = None
    for factor in codec.factors:
        try:
            figure = run(dem, codec, scale, layout, way, factor)
        except (RuntimeError, ValueError, OverflowError, ic.DelayedImportError) as refusal:
            return {"why": str(refusal) or type(refusal).__name__}
        if factor == 1.0:
            asked = figure["error"]
        if figure["error"] <= scale.error * (1 + 1e-9) + 1e-9:
            return figure | {
                "factor": factor,
                "fill": way,
                "error_as_asked": asked if asked is not None else None,
            }
    return {"why": f"no tolerance holds: true error {asked:.6g}", "error_as_asked": asked}


def run(dem: Dem, codec: Codec, scale: Scale, layout: str, way: str, factor: float) -> dict:
    """Encodes and decodes every piece; the true error over all samples that have a height."""
    filled, valid = dem.filled(way), dem.valid
    total, worst, encode, decode = 0, 0.0, 0.0, 0.0
    for window in windows(filled.shape, LAYOUTS[layout]):
        here = valid[window]
        if not here.any():
            continue
        piece = Piece(np.ascontiguousarray(filled[window]), here, scale)
        started = time.perf_counter()
        data = codec.encode(piece, scale.error * factor)
        encoded = time.perf_counter()
        back = codec.decode(data, piece)
        decode += time.perf_counter() - encoded
        encode += encoded - started
        total += len(data)
        off = np.abs(back - dem.heights[window])[here]
        worst = max(worst, float("inf") if np.isnan(off).any() else float(off.max()))
    return {"bytes": total, "error": worst, "encode_s": encode, "decode_s": decode}
