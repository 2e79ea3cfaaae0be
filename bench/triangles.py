"""Triangles of the encoding `tin` at equal true error, beside greedy Delaunay insertion; and what its options do.

    triangles.py DATA [equal | cuts | metric | lambda]

DATA is the folder with the DEMs. Each table is made of stores built here with the release server; their errors are
those declared, which `inspect --verify` and the tests hold to be true at each sample. Greedy insertion's own are
measured at each sample, too.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import rasterio
from simplifiers import delatin, true_error

SERVER = Path(__file__).parent.parent / "target/release/diamantina-server"
CROPS = ["hills", "alps"]
ERRORS = [5.0, 10.0, 30.0]
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


TABLES = {"equal": equal, "cuts": cuts, "metric": metric, "lambda": weights}

if __name__ == "__main__":
    if len(sys.argv) < 2 or any(name not in TABLES for name in sys.argv[2:]):
        raise SystemExit(__doc__)
    for chosen in sys.argv[2:] or TABLES:
        TABLES[chosen](Path(sys.argv[1]))
        print()
