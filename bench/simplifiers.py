"""Triangles that simplifiers need for a maximum error, and the error that their result truly has.

Every sample is compared with the triangle above or below it: only that bounds a vertical error.
"""

import time

import numpy as np
from pydelatin import Delatin
from pymartini import Martini

from dems import DATASETS_FIRST, Dem

ASKED_METRES = 10.0
# Work arrays hold at most this many numbers.
WORK_MAX = 1 << 24


def measure(cache, dems: list[Dem]) -> list[dict]:
    """Greedy insertion and right-triangulated networks by their own errors, on the first DEMs."""
    rows = []
    for dem in [dem for dem in dems if dem.name in DATASETS_FIRST]:
        for name, simplify in (("pydelatin 0.4.0, greedy", delatin), ("pymartini 0.6.0, RTIN", martini)):
            figure = cache.get(dem.hash, name, ASKED_METRES)
            if figure is None:
                started = time.process_time()
                vertices, triangles = simplify(dem.heights.astype(np.float32), ASKED_METRES)
                seconds = time.process_time() - started
                error, left = true_error(vertices[:, :2], vertices[:, 2], triangles, dem.heights)
                figure = {"triangles": len(triangles), "vertices": len(vertices), "true_error": error}
                figure |= {"samples_not_covered": left, "msamples_per_second": dem.samples / seconds / 1e6}
                cache.put(figure, dem.hash, name, ASKED_METRES)
            rows.append({"dem": dem.name, "simplifier": name, "asked": ASKED_METRES} | figure)
    return rows


def delatin(heights: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as column, row, height; and triangles."""
    tin = Delatin(heights, max_error=error)
    vertices = tin.vertices.reshape(-1, 3).astype(np.float64)
    # The library counts rows from the bottom.
    vertices[:, 1] = heights.shape[0] - 1 - vertices[:, 1]
    return vertices, tin.triangles.reshape(-1, 3)


def martini(heights: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    vertices, triangles = Martini(heights.shape[0]).create_tile(heights).get_mesh(error)
    vertices = vertices.reshape(-1, 2).astype(int)
    z = heights[vertices[:, 1], vertices[:, 0]]
    return np.column_stack([vertices, z]).astype(np.float64), triangles.reshape(-1, 3)


def true_error(
    xy: np.ndarray, z: np.ndarray, triangles: np.ndarray, heights: np.ndarray
) -> tuple[float, int]:
    """The largest distance of a sample from its triangle, and how many samples have none."""
    surface = rasterise(xy, z, triangles, heights.shape)
    covered = np.isfinite(surface)
    wanted = np.isfinite(heights)
    off = np.abs(surface - heights)[covered & wanted]
    return float(off.max(initial=0.0)), int(np.count_nonzero(wanted & ~covered))


def rasterise(xy: np.ndarray, z: np.ndarray, triangles: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a triangulation at every sample, NaN where there is no triangle.

    Triangles are taken together with others of about their size: each class walks boxes of one size.
    """
    surface = np.full(shape, np.nan)
    corners, tops = xy[triangles], z[triangles]
    low = np.ceil(corners.min(1) - 1e-9).astype(int)
    high = np.floor(corners.max(1) + 1e-9).astype(int)
    spans = np.maximum(high - low + 1, 0)
    classes = np.ceil(np.log2(np.maximum(spans, 1))).astype(int)
    for pair in np.unique(classes, axis=0):
        members = np.flatnonzero((classes == pair).all(1) & (spans > 0).all(1))
        width, height = 1 << pair[0], 1 << pair[1]
        each = max(1, WORK_MAX // (width * height))
        for start in range(0, len(members), each):
            part = members[start : start + each]
            _fill(surface, corners[part], tops[part], low[part], width, height)
    return surface


def _fill(surface, corners, tops, low, width, height) -> None:
    """Barycentric coordinates of a box of samples in each of many triangles."""
    x = low[:, 0, None, None] + np.arange(width)[None, None, :]
    y = low[:, 1, None, None] + np.arange(height)[None, :, None]
    a, b, c = (corners[:, i, :, None, None] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        v = ((x - a[:, 0]) * (c[:, 1] - a[:, 1]) - (y - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
        w = ((b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (b[:, 1] - a[:, 1]) * (x - a[:, 0])) / area
    inside = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1 + 1e-9) & (area != 0)
    inside &= (x < surface.shape[1]) & (y < surface.shape[0]) & (x >= 0) & (y >= 0)
    t = tops[:, :, None, None]
    z = t[:, 0] + v * (t[:, 1] - t[:, 0]) + w * (t[:, 2] - t[:, 0])
    at = np.nonzero(inside)
    surface[np.broadcast_to(y, inside.shape)[at], np.broadcast_to(x, inside.shape)[at]] = z[at]
