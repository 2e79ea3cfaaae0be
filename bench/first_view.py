"""Bytes of one view: ours, as our client fetches them, beside tiles that others would fetch for it.

The view is a picture of 1380 x 768 in which no sample is off by more than a pixel, or by more than the error
of our store where a box is so near that a pixel is less: for every tile, its true
error (its decoded surface against every sample of the source below it) over the distance of its box from the
eye. Two pyramids stand for others, both over the raster's own grid, so that no reprojection is counted:

- quantized-mesh (gzip): greedy triangulations, decoded again from the encoded bytes before they are compared;
  of several pyramids that double their error a level, the one best for the view;
- terrain-rgb: WebP, lossless, of every 2^L-th sample, heights rounded as far as the error permits.

Each is counted twice. `fixed`: tiles made before the view is known, a bound or a spacing for each level, as a
server would hold them. `fitted`: each tile made for this very view, and the cut through the pyramid with
the fewest bytes: no pyramid of that kind can do better. Neither is charged for skirts, normals, metadata,
nor for the coarser tiles that real clients load on the way.
"""

import argparse
import gzip
import hashlib
import io
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import imagecodecs as ic
import numpy as np
import quantized_mesh_encoder
from pydelatin import Delatin

import simplifiers
from dems import all_dems, fill
from measure import Cache
from ours import build_command

ROOT = Path(__file__).resolve().parent.parent
SIZE = (1380, 768)
FOV_Y = math.pi / 4
# Of a quantized-mesh tile of the finest level, in samples a side; and of terrain-rgb tiles, in pixels.
MESH_SIDE = 64
IMAGE_SIDES = (256, 512)
# The coordinate of a quantized-mesh vertex goes from 0 to this.
FULL = 32767


@dataclass
class View:
    """A camera over a raster whose rows go north from the south."""

    eye: np.ndarray
    target: np.ndarray
    cell: np.ndarray
    heights: np.ndarray
    # Metres that any tile may be off: the error of our store.
    least: float

    def pixels_per_radian(self) -> float:
        return SIZE[1] / (2 * math.tan(FOV_Y / 2))

    def planes(self) -> list[tuple[np.ndarray, float]]:
        """Inward normals and offsets of the four sides and of the plane of the eye."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        up = np.array([0.0, 1.0, 0.0]) if abs(forward[2]) > 0.999999 else np.array([0.0, 0.0, 1.0])
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        top = np.cross(right, forward)
        tan_y = math.tan(FOV_Y / 2)
        tan_x = tan_y * SIZE[0] / SIZE[1]
        sides = [
            forward * tan_x + right,
            forward * tan_x - right,
            forward * tan_y + top,
            forward * tan_y - top,
        ]
        return [
            (n / np.linalg.norm(n), -float(n @ self.eye) / float(np.linalg.norm(n)))
            for n in [*sides, forward]
        ]

    def tolerance(self, tile: "Tile") -> float | None:
        """Metres that a tile may be off, for a pixel; `None` outside the view. A box around the eye, as large
        tiles of rough ground have, asks no more than the finest error: others are not charged for it."""
        low, high = tile.box(self)
        for normal, offset in self.planes():
            if normal @ np.where(normal >= 0, high, low) + offset < 0:
                return None
        nearest = np.clip(self.eye, low, high)
        return max(self.least, float(np.linalg.norm(nearest - self.eye)) / self.pixels_per_radian())


@dataclass(frozen=True)
class Tile:
    """A square of a quadtree over samples: `side << level` cells from `column`, `row` on."""

    level: int
    column: int
    row: int
    side: int

    @property
    def span(self) -> int:
        return self.side << self.level

    def children(self) -> list["Tile"]:
        half = self.span // 2
        return [
            Tile(self.level - 1, self.column + i * half, self.row + j * half, self.side)
            for j in (0, 1)
            for i in (0, 1)
        ]

    def samples(self, heights: np.ndarray) -> np.ndarray:
        """Those within and on the rim."""
        return heights[self.row : self.row + self.span + 1, self.column : self.column + self.span + 1]

    def empty(self, heights: np.ndarray) -> bool:
        """Beyond the raster, or a mere line of it that the neighbour has, too."""
        rows, columns = heights.shape
        last = self.row >= rows - 1 or self.column >= columns - 1
        return last or not np.isfinite(self.samples(heights)).any()

    def box(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        part = self.samples(view.heights)
        start = np.array([self.column, self.row]) * view.cell
        end = start + (np.array(part.shape[::-1]) - 1) * view.cell
        return np.append(start, np.nanmin(part)), np.append(end, np.nanmax(part))


def root(heights: np.ndarray, side: int) -> Tile:
    level = max(0, math.ceil(math.log2((max(heights.shape) - 1) / side)))
    return Tile(level, 0, 0, side)


def cheapest(view: View, tile: Tile, cost) -> tuple[int, int]:
    """Bytes and tiles of the cut with the fewest bytes; `cost(tile, tolerance)` gives those of a tile, or
    `None` where it cannot hold the tolerance."""
    if tile.empty(view.heights):
        return 0, 0
    tolerance = view.tolerance(tile)
    if tolerance is None:
        return 0, 0
    own = cost(tile, tolerance)
    if tile.level == 0:
        if own is None:
            raise ValueError(f"{tile}: no tile within {tolerance:.3g} m")
        return own, 1
    below = [cheapest(view, child, cost) for child in tile.children()]
    parts = (sum(size for size, _ in below), sum(count for _, count in below))
    return parts if own is None or parts[0] <= own else (own, 1)


def coarsest(view: View, tile: Tile, cost) -> tuple[int, int]:
    """The cut that clients make: a tile that is good enough is not split."""
    if tile.empty(view.heights):
        return 0, 0
    tolerance = view.tolerance(tile)
    if tolerance is None:
        return 0, 0
    own = cost(tile, tolerance)
    if own is not None:
        return own, 1
    if tile.level == 0:
        raise ValueError(f"{tile}: no tile within {tolerance:.3g} m")
    below = [coarsest(view, child, cost) for child in tile.children()]
    return sum(size for size, _ in below), sum(count for _, count in below)


class Meshes:
    """Quantized-mesh tiles of a raster, kept by footprint and error."""

    def __init__(self, cache: Cache, key: str, heights: np.ndarray):
        self.cache, self.key = cache, key
        self.heights, self.filled = heights, fill(heights, "smooth")

    def tile(self, tile: Tile, error: float) -> dict:
        """Bytes and true error of the triangulation made for an error."""
        where = (self.key, "quantized-mesh", tile, round(error, 6))
        known = self.cache.get(*where)
        if known is None:
            data, shape = self._encode(tile, error)
            true, missing = simplifiers.true_error(*decode_mesh(data, shape), tile.samples(self.heights))
            if missing:
                raise ValueError(f"{tile}: {missing} samples under no triangle")
            known = self.cache.put({"bytes": len(gzip.compress(data, 9, mtime=0)), "error": true}, *where)
        return known

    def fitted(self, tile: Tile, tolerance: float) -> int | None:
        """As coarse as the tolerance allows. Rounding to the tile's grid moves vertices: a hair is left."""
        for part in (1.0, 0.98, 0.9, 0.7, 0.4):
            found = self.tile(tile, tolerance * part)
            if found["error"] <= tolerance:
                return found["bytes"]
        return None

    def fixed(self, finest: float):
        def cost(tile: Tile, tolerance: float) -> int | None:
            found = self.tile(tile, finest * 2.0**tile.level)
            return found["bytes"] if found["error"] <= tolerance else None

        return cost

    def best_fixed(self, view: View) -> tuple[tuple[int, int], float]:
        """The cut of the best of several pyramids, and its error at tiles of `MESH_SIDE` samples. Finer
        levels, which some of them would have below, are not needed for the view."""
        cuts = []
        for finest in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
            try:
                cuts.append((coarsest(view, root(self.heights, MESH_SIDE), self.fixed(finest)), finest))
            except ValueError:
                # Its tiles are too coarse for what is near the eye.
                break
        if not cuts:
            raise ValueError("no pyramid of half a metre or more serves the view")
        return min(cuts)

    def _encode(self, tile: Tile, error: float) -> tuple[bytes, tuple[int, int]]:
        part = np.ascontiguousarray(tile.samples(self.filled), dtype=np.float32)
        tin = Delatin(part, max_error=error)
        vertices = tin.vertices.reshape(-1, 3).astype(np.float64)
        vertices[:, 1] = part.shape[0] - 1 - vertices[:, 1]
        triangles = in_order(vertices, tin.triangles.reshape(-1, 3))
        # Vertices in the order of their first use, as the format's indices want.
        flat = triangles.ravel()
        first = np.sort(np.unique(flat, return_index=True)[1])
        order = flat[first]
        place = np.empty(len(vertices), dtype=np.int64)
        place[order] = np.arange(len(order))
        vertices, triangles = vertices[order], place[triangles]
        scale = FULL / (np.array(part.shape[::-1]) - 1)
        # The encoder cuts fractions off; a hundredth keeps rounded ones whole.
        vertices[:, :2] = np.minimum(np.rint(vertices[:, :2] * scale) + 0.01, FULL)
        out = io.BytesIO()
        bounds = (0.0, 0.0, float(FULL), float(FULL))
        quantized_mesh_encoder.encode(
            out,
            vertices.astype(np.float32),
            triangles.astype(np.uint32),
            bounds=bounds,
            sphere_method="bounding_box",
        )
        return out.getvalue(), part.shape


def in_order(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles along a Z curve: neighbours in space are neighbours in the file, and small to tell apart."""
    middle = vertices[triangles, :2].mean(axis=1).astype(np.int64)
    code = np.zeros(len(triangles), dtype=np.int64)
    for bit in range(16):
        code |= (middle[:, 0] >> bit & 1) << 2 * bit | (middle[:, 1] >> bit & 1) << 2 * bit + 1
    return triangles[np.argsort(code, kind="stable")]


def decode_mesh(data: bytes, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A quantized-mesh tile: places in samples, heights, triangles."""
    low, high = struct.unpack_from("<ff", data, 24)
    count = struct.unpack_from("<I", data, 88)[0]
    raw = np.frombuffer(data, "<u2", 3 * count, 92).astype(np.int64).reshape(3, count)
    u, v, h = np.cumsum(raw >> 1 ^ -(raw & 1), axis=1)
    wide = count > 65536
    at = 92 + 6 * count
    at += -at % (4 if wide else 2)
    triangles = struct.unpack_from("<I", data, at)[0]
    codes = np.frombuffer(data, "<u4" if wide else "<u2", 3 * triangles, at + 4).astype(np.int64)
    # A code of zero is the next new vertex; others count back from it.
    new = codes == 0
    indices = np.cumsum(new) - new - codes
    xy = np.column_stack([u, v]) * (np.array(shape[::-1]) - 1) / FULL
    return xy, low + h * (high - low) / FULL, indices.reshape(-1, 3)


class Images:
    """Terrain-rgb tiles of a raster: of every 2^L-th sample, drawn as a bilinear surface."""

    def __init__(self, cache: Cache, heights: np.ndarray):
        self.cache, self.heights, self.filled = cache, heights, fill(heights, "smooth")

    def error(self, tile: Tile, step: float) -> float:
        """The true error of a tile whose heights are rounded to multiples of `step` metres."""
        part, stride = tile.samples(self.filled), 1 << tile.level
        knots = [np.unique(np.append(np.arange(0, n, stride), n - 1)) for n in part.shape]
        surface = np.rint(part[np.ix_(*knots)] / step) * step
        for axis in (0, 1):
            every = np.arange(part.shape[axis])
            left = np.minimum(
                np.searchsorted(knots[axis], every, side="right") - 1, max(len(knots[axis]) - 2, 0)
            )
            right = np.minimum(left + 1, len(knots[axis]) - 1)
            gap = np.maximum(knots[axis][right] - knots[axis][left], 1)
            share = ((every - knots[axis][left]) / gap).reshape((-1, 1) if axis == 0 else (1, -1))
            surface = np.take(surface, left, axis) * (1 - share) + np.take(surface, right, axis) * share
        return float(np.nanmax(np.abs(surface - tile.samples(self.heights))))

    def size(self, tile: Tile, step: float, own: bool) -> int:
        """Bytes of the picture, without the rim that the neighbour has. `own`: a value is a step; else tenths
        of a metre above -10 km."""
        part = tile.samples(self.filled)[:: 1 << tile.level, :: 1 << tile.level][: tile.side, : tile.side]
        values = np.rint(part / step).astype(np.int64)
        values = values - values.min() if own else np.rint((values * step + 10_000) * 10).astype(np.int64)
        rgb = np.stack([values >> 16, values >> 8 & 255, values & 255], axis=-1).astype(np.uint8)
        where = ("webp 100 6", rgb.shape, hashlib.sha256(rgb.tobytes()).hexdigest())
        known = self.cache.get(*where)
        if known is None:
            data = ic.webp_encode(np.ascontiguousarray(rgb), level=100, lossless=True, method=6, numthreads=1)
            if not np.array_equal(ic.webp_decode(data)[..., :3], rgb):
                raise ValueError(f"{tile}: a picture did not come back")
            known = self.cache.put({"bytes": len(data)}, *where)
        return known["bytes"]

    def fitted(self, tile: Tile, tolerance: float) -> int | None:
        """The cheapest of several roundings that hold the tolerance."""
        if self.error(tile, 1e-6) > tolerance:
            return None
        steps = [2 * tolerance * part for part in (1.0, 0.7, 0.5, 0.35, 0.25, 0.125, 0.06)]
        held = [step for step in steps if self.error(tile, step) <= tolerance]
        # Coarser steps cost less: the first two that hold.
        return min((self.size(tile, step, own=True) for step in held[:2]), default=None)

    def fixed(self, step: float):
        """Rounded twice as coarsely a level, as its resampling is coarser, too."""

        def cost(tile: Tile, tolerance: float) -> int | None:
            coarse = step * 2.0**tile.level
            held = self.error(tile, coarse) <= tolerance
            return self.size(tile, coarse, own=False) if held else None

        return cost


def ours(server: Path, client: Path, dem, error: float, work: Path, low: bool) -> tuple[dict, dict]:
    """What our client reports of the view, and the layer of the scene. `low`: not from where all is seen, but
    from the south of it, 2000 m above the ground, looking north."""
    with tempfile.TemporaryDirectory(dir=work) as folder:
        store = Path(folder) / "scene"
        command = build_command(server, dem, error, store, work)
        report = subprocess.run(command, check=True, capture_output=True, text=True)
        layer = json.loads(report.stdout)["scene"]["layers"][0]
        serve = [str(server), "serve", str(store), "--listen", "127.0.0.1:0"]
        with subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
            try:
                url = next(
                    word for line in running.stdout for word in line.split() if word.startswith("http://")
                )
                render = [
                    str(client),
                    "render",
                    url.rstrip(".,"),
                    "-o",
                    str(Path(folder) / "view.png"),
                    "--json",
                    "-",
                ]
                render += ["--size", f"{SIZE[0]}x{SIZE[1]}", "--error-pixels", "1"]
                if low:
                    eye, target = low_view(layer, dem)
                    render += [f"--eye={eye}", f"--target={target}"]
                drawn = subprocess.run(render, check=True, capture_output=True, text=True).stdout
            finally:
                running.terminate()
    return json.loads(drawn), layer


def low_view(layer: dict, dem) -> tuple[str, str]:
    heights = dem.heights[::-1]
    rows, columns = heights.shape
    x, y = layer["cell"][0] * (columns // 2), layer["cell"][1] * (rows // 20)
    eye = [
        layer["origin"][0] + x,
        layer["origin"][1] + y,
        np.nanmax(heights[rows // 20, columns // 2]) + 2000.0,
    ]
    target = [eye[0], layer["origin"][1] + layer["cell"][1] * (rows // 2), float(np.nanmean(heights))]
    return ",".join(f"{v:.3f}" for v in eye), ",".join(f"{v:.3f}" for v in target)


def rows_of(cache: Cache, dem, error: float, server: Path, client: Path, work: Path, low: bool) -> list[dict]:
    report, layer = ours(server, client, dem, error, work, low)
    if not report["complete"]:
        raise SystemExit(f"{dem.name}: our own view was not complete within the client's timeout")
    origin = np.array([*layer["origin"], 0.0])
    heights = np.ascontiguousarray(dem.heights[::-1])
    eye, target = np.array(report["eye"]) - origin, np.array(report["target"]) - origin
    view = View(eye, target, np.array(layer["cell"]), heights, error)
    meshes, images = Meshes(cache, dem.hash, heights), Images(cache, heights)
    name = f"{dem.name}, {'low' if low else 'overview'}"
    base = {"view": name, "what": "diamantina", "bytes": report["bytes"], "tiles": report["requests"]}
    rows = [base | {"error_pixels": report["largest_error_pixels"]}]

    def add(what: str, cut: tuple[int, int]) -> None:
        rows.append({"view": name, "what": what, "bytes": cut[0], "tiles": cut[1]})
        print(f"{name}: {what}: {cut[0]} bytes in {cut[1]} tiles", file=sys.stderr, flush=True)

    print(f"{name}: ours {report['bytes']} bytes", file=sys.stderr, flush=True)
    cut, finest = meshes.best_fixed(view)
    add(f"quantized-mesh, gzip, fixed ({finest:g} m at {MESH_SIDE}², twice that a level)", cut)
    add("quantized-mesh, gzip, fitted", cheapest(view, root(heights, MESH_SIDE), meshes.fitted))
    for side in IMAGE_SIDES:
        # The largest power of two of tenths of a metre that keeps the error of the store.
        step = 2.0 ** math.floor(math.log2(max(20 * error, 1))) / 10
        top = root(heights, side)
        add(
            f"terrain-rgb WebP {side}², fixed (Mapbox, steps of {step:g} m, twice that a level)",
            coarsest(view, top, images.fixed(step)),
        )
        add(f"terrain-rgb WebP {side}², fitted", cheapest(view, top, images.fitted))
    return rows


def table(rows: list[dict]) -> str:
    lines = ["| view | what | bytes | tiles or requests | times ours |", "|---|---|---|---|---|"]
    base = {}
    for row in rows:
        if row["what"] == "diamantina":
            base[row["view"]] = row["bytes"]
        ratio = f"{row['bytes'] / base[row['view']]:.2f}"
        lines.append(f"| {row['view']} | {row['what']} | {row['bytes']} | {row['tiles']} | {ratio} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, help="folder of DEMs [default: DIAMANTINA_DATA, else ../shared/data]"
    )
    parser.add_argument(
        "--only", default="alps,hills,puget,rainier", help="names of DEMs, with commas between"
    )
    parser.add_argument("--max-error", type=float, default=1.0, help="of our stores, in metres")
    parser.add_argument("--json", type=Path, help="write every figure here")
    arguments = parser.parse_args()
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    folder = arguments.data or Path(os.environ.get("DIAMANTINA_DATA", ROOT.parent / "shared" / "data"))
    programs = [target / "release" / f"diamantina-{end}" for end in ("server", "client")]
    for program in programs:
        if not program.exists():
            raise SystemExit(
                f"{program}: not found. Build it: cargo build --release --locked -p {program.name}"
            )
    if not (folder / "MANIFEST.tsv").exists():
        raise SystemExit(f"{folder}: no MANIFEST.tsv there. Name the folder of DEMs with DIAMANTINA_DATA")
    cache, names = Cache(target / "bench-peers" / "tiles.jsonl"), arguments.only.split(",")
    rows = []
    for dem in all_dems(folder):
        if dem.name in names:
            for low in (False, True):
                rows += rows_of(cache, dem, arguments.max_error, *programs, target / "bench-peers", low)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
