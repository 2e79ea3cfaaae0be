"""Outlines of lakes, found in a DEM: its largest level areas, as GeoJSON for `diamantina-server zone`.

    python bench/lake.py DEM -o lake.geojson [--rank 1] [--least-cells 50]

A lake is made of the cells whose four samples have one height and which share sides; those within --inset cells of
its shore are left out, so that the outline runs over level ground even once a build has resampled the heights. Cells
that touch at a corner only are left out, too, since an outline must not touch itself. Coordinates are longitude and
latitude (RFC 7946).
"""

import argparse
import json

import numpy as np
import rasterio
from rasterio.warp import transform
from scipy import ndimage


def level_cells(heights, valid):
    """The label of the level area that each cell belongs to, 0 for none, and how many there are."""
    a, b, c, d = heights[:-1, :-1], heights[:-1, 1:], heights[1:, :-1], heights[1:, 1:]
    ok = valid[:-1, :-1] & valid[:-1, 1:] & valid[1:, :-1] & valid[1:, 1:]
    # Neighbouring cells share samples, so all cells of one area have the same height.
    return ndimage.label(ok & (a == b) & (a == c) & (a == d))


def without_corners(cells):
    """The cells of the largest part that share sides, none of which touch at a corner only."""
    cells = cells.copy()
    while True:
        nw, ne, sw, se = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
        one, other = nw & se & ~ne & ~sw, ne & sw & ~nw & ~se
        if not one.any() and not other.any():
            break
        cells[1:, 1:] &= ~one
        cells[1:, :-1] &= ~other
    labels, count = ndimage.label(cells)
    sizes = ndimage.sum_labels(cells, labels, range(1, count + 1))
    return labels == 1 + int(np.argmax(sizes))


def rings(cells):
    """Closed walks around the cells, outline first, as rows and columns of samples: corners only."""
    padded = np.pad(cells, 1)
    steps = {}
    for i, j in zip(*np.nonzero(padded)):
        # Each side between inside and outside, with the inside on the left.
        for (di, dj), a, b in [
            ((-1, 0), (i, j + 1), (i, j)),
            ((0, -1), (i, j), (i + 1, j)),
            ((1, 0), (i + 1, j), (i + 1, j + 1)),
            ((0, 1), (i + 1, j + 1), (i, j + 1)),
        ]:
            if not padded[i + di, j + dj]:
                steps[a] = b
    found = []
    while steps:
        start = at = next(iter(steps))
        ring = []
        while at in steps:
            ring.append(at)
            at = steps.pop(at)
        assert at == start, "an outline that does not close"
        corners = [
            p
            for before, p, after in zip(ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1])
            if (p[0] - before[0], p[1] - before[1]) != (after[0] - p[0], after[1] - p[1])
        ]
        found.append([(i - 1, j - 1) for i, j in corners])

    def area(ring):
        return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(ring, ring[1:] + ring[:1])))

    return sorted(found, key=area, reverse=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dem")
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--rank", type=int, default=1, help="1 for the largest lake")
    parser.add_argument("--inset", type=int, default=1, help="cells that the outline keeps from the shore")
    parser.add_argument("--least-cells", type=int, default=50)
    args = parser.parse_args()
    with rasterio.open(args.dem) as source:
        heights = source.read(1)
        valid = source.read_masks(1) > 0
        crs, affine = source.crs, source.transform
    labels, count = level_cells(heights, valid)
    sizes = ndimage.sum_labels(labels > 0, labels, range(1, count + 1))
    order = np.argsort(-sizes)
    for rank, at in enumerate(order[: max(args.rank, 6)], start=1):
        i, j = ndimage.maximum_position(labels == at + 1)
        print(f"{rank}: {int(sizes[at])} cells at {heights[i, j]} m, around row {i}, column {j}")
    lake = labels == order[args.rank - 1] + 1
    inner = ndimage.binary_erosion(lake, np.ones((3, 3)), iterations=args.inset) if args.inset else lake
    cells = without_corners(inner)
    if cells.sum() < args.least_cells:
        raise SystemExit(f"{args.dem}: the lake has {cells.sum()} cells only, expected {args.least_cells} or more")
    coordinates = []
    for ring in rings(cells):
        # Samples are points in the middle of pixels.
        xs, ys = zip(*(affine * (j + 0.5, i + 0.5) for i, j in ring))
        lon, lat = transform(crs, "EPSG:4326", xs, ys)
        ring = [[round(x, 8), round(y, 8)] for x, y in zip(lon, lat)]
        coordinates.append(ring + ring[:1])
    with open(args.output, "w", encoding="utf-8") as out:
        json.dump({"type": "Polygon", "coordinates": coordinates}, out)
    corners = sum(map(len, coordinates))
    print(f"{args.output}: {int(cells.sum())} cells, {len(coordinates)} rings, {corners} corners")


if __name__ == "__main__":
    main()
