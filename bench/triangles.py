"""Triangles of the encoding `tin` at equal true error, beside greedy Delaunay insertion; and what its options do.

    triangles.py DATA [equal | others | cuts | metric | lambda]

DATA is the folder with the DEMs. Each table is made of stores built here with the release server; their errors are
those declared, which `inspect --verify` and the tests hold to be true at each sample. Greedy insertion's own are
measured at each sample, too.
"""

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import meshoptimizer
import numpy as np
import rasterio
from simplifiers import delatin, martini, true_error

SERVER = Path(__file__).parent.parent / "target/release/diamantina-server"
CROPS = ["hills", "alps"]
ERRORS = [5.0, 10.0, 30.0]
# Halvings of the error asked of a simplifier that keeps another one.
HALVINGS = 6
METRES_PER_DEGREE = 111_320.0
# Levels of a crop of 1025 x 1025 samples with patches of 32 segments.
LEVELS = 10


def inspect(dem: Path, *options: str) -> dict:
    """Builds a store of triangles alone; what it holds."""
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        build = [SERVER, "build", dem, "-o", store, "--crs", "source", "--encoding", "tin", *options]
        subprocess.run(build, check=True, capture_output=True)
        found = subprocess.run([SERVER, "inspect", store, "--verify", "--json"], check=True, capture_output=True)
    return json.loads(found.stdout)["layers"][0]["tin"]


def greedy(dem: Path, error: float) -> tuple[int, float]:
    """Triangles of greedy insertion, and their true error."""
    with rasterio.open(dem) as source:
        heights = source.read(1).astype(np.float32)
    vertices, triangles = delatin(heights, error)
    found, _ = true_error(vertices[:, :2], vertices[:, 2], triangles, heights.astype(np.float64))
    return len(triangles), found


def coarsest(dem: Path, error: float, count: int) -> tuple[int, dict, dict]:
    """The coarsest level whose patches keep an error that was asked of each collapse, and fit in payloads."""
    # A payload holds some 49,000 triangles: fewer than half of greedy insertion's were never found to be enough.
    first = next(level for level in range(LEVELS) if count / 2 / 2**level < 49_000)
    for level in range(first, LEVELS - 1):
        # The error of a level's patches is that of the finest, twice as much every two levels.
        finest = error / 2 ** ((LEVELS - 2 - level) / 2)
        levels = inspect(dem, "--patch-error", str(finest))["levels"]
        if levels[level + 1]["error_max"] <= error * 1.005:
            return level, levels[level], levels[level + 1]
    raise SystemExit(f"{dem}: no level keeps {error} m")


def equal(data: Path) -> None:
    print("| DEM | error | greedy | its true error | tin | its true error | tin / greedy | payloads |")
    print("|---|---|---|---|---|---|---|---|")
    for name in CROPS:
        dem = data / f"srtm3_crops/{name}_1025.tif"
        for error in ERRORS:
            count, found = greedy(dem, error)
            level, split, below = coarsest(dem, error, count)
            ratio = split["triangles"] / count
            print(
                f"| {name} | {error:g} m | {count} | {found:.2f} m | {split['triangles']} | {below['error_max']:.2f} m"
                f" | {ratio:.2f} | {split['diamonds']} |",
                flush=True,
            )


def meshopt(dem: Path, heights: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """meshoptimizer's simplifier, which measures its errors in space: so x and y are metres to it."""
    with rasterio.open(dem) as source:
        across, down = source.transform.a, -source.transform.e
        latitude = source.transform.f - down * heights.shape[0] / 2
    cell = [across * METRES_PER_DEGREE * math.cos(math.radians(latitude)), down * METRES_PER_DEGREE]
    rows, columns = heights.shape
    y, x = np.mgrid[0:rows, 0:columns]
    places = np.column_stack([x.ravel(), y.ravel(), heights.ravel()]).astype(np.float64)
    metres = (places * [*cell, 1.0]).astype(np.float32)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    quads = corner[:, None] + [0, 1, columns, 1, columns + 1, columns]
    indices = quads.ravel().astype(np.uint32)
    kept = np.zeros_like(indices)
    count = meshoptimizer.simplify(
        kept, indices, metres, target_index_count=3, target_error=error, options=meshoptimizer.SIMPLIFY_ERROR_ABSOLUTE
    )
    return places, kept[:count].reshape(-1, 3)


def held(heights: np.ndarray, error: float, simplify: Callable) -> str:
    """The fewest triangles found whose true error is kept, by asking for less: what was asked, triangles, true error."""
    low, high, best = 0.0, error, None
    for asked in [error] + [None] * HALVINGS:
        asked = asked or (low + high) / 2
        places, triangles = simplify(asked)
        found, left = true_error(places[:, :2], places[:, 2], triangles, heights)
        if found <= error and left == 0:
            low, best = asked, f"{asked:.2f} m, {len(triangles)}, {found:.2f} m"
        else:
            high = asked
    return best or f"not held: {asked:.2f} m, {len(triangles)}, {found:.2f} m"


def others(data: Path) -> None:
    """Simplifiers that do not keep what is asked of them: as they are, and asked for so little that they do."""
    print("| DEM | error | simplifier | asked for it: triangles, true error | held to it: asked, triangles, true error |")
    print("|---|---|---|---|---|")
    for name in CROPS:
        dem = data / f"srtm3_crops/{name}_1025.tif"
        with rasterio.open(dem) as source:
            heights = source.read(1).astype(np.float64)
        ways = {
            "RTIN (pymartini)": lambda asked: martini(heights.astype(np.float32), asked),
            "meshoptimizer": lambda asked: meshopt(dem, heights, asked),
        }
        for error in ERRORS:
            for way, simplify in ways.items():
                places, triangles = simplify(error)
                found, _ = true_error(places[:, :2], places[:, 2], triangles, heights)
                kept = held(heights, error, simplify)
                print(f"| {name} | {error:g} m | {way} | {len(triangles)}, {found:.2f} m | {kept} |", flush=True)


def cuts(data: Path) -> None:
    print("| DEM | error | greedy | 256 a patch | 1024 a patch | 4096 a patch |")
    print("|---|---|---|---|---|---|")
    for name in CROPS:
        dem = data / f"srtm3_crops/{name}_1025.tif"
        found = [inspect(dem, "--patch-triangles", n)["cuts"] for n in ("256", "1024", "4096")]
        for error in ERRORS:
            count, _ = greedy(dem, error)
            drawn = [next(c["triangles"] for c in one if c["error"] == error) for one in found]
            print(f"| {name} | {error:g} m | {count} | " + " | ".join(map(str, drawn)) + " |", flush=True)


def metric(data: Path) -> None:
    print("| DEM | level | triangles | error, normal | error, quadric |")
    print("|---|---|---|---|---|")
    for name in CROPS:
        dem = data / f"srtm3_crops/{name}_1025.tif"
        by = [inspect(dem, "--metric", m)["levels"] for m in ("normal", "quadric")]
        for level in range(1, LEVELS):
            counts = [levels[level - 1]["triangles"] for levels in by]
            errors = [levels[level]["error_max"] for levels in by]
            print(f"| {name} | {level} | {counts[0]}, {counts[1]} | {errors[0]:g} m | {errors[1]:g} m |", flush=True)


def weights(data: Path) -> None:
    dem = data / "qgis_training/SRTM.tif"
    print("| lambda | " + " | ".join(f"level {level}" for level in range(1, 9)) + " |")
    print("|---|" + "---|" * 8)
    for weight in ("0", "0.01", "0.1", "1", "10", "100"):
        levels = inspect(dem, "--lambda", weight, "--patch-triangles", "1024")["levels"]
        cells = [f"{levels[level]['apart_max']:.0f} m ({levels[level - 1]['triangles']})" for level in range(1, 9)]
        print(f"| {weight} | " + " | ".join(cells) + " |", flush=True)


TABLES = {"equal": equal, "others": others, "cuts": cuts, "metric": metric, "lambda": weights}

if __name__ == "__main__":
    if len(sys.argv) < 2 or any(name not in TABLES for name in sys.argv[2:]):
        raise SystemExit(__doc__)
    for chosen in sys.argv[2:] or TABLES:
        TABLES[chosen](Path(sys.argv[1]))
        print()
