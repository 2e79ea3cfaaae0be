"""What each choice of the `points` codec is worth, as entropies of whole rasters, in bits a sample.

Not a bitstream: no diamonds, no headers, and tables learnt from what they code. But it takes seconds, so a choice can
be judged before it is written. The loop is closed, as in the codec: old points are what a receiver would have.
The finest ten steps of the bintree are coded; coarser points are rounded.

    scripts/bench-peers choices DEM.tif [DEM.tif ...] [--errors 1,5,16]
"""

import argparse

import numpy as np
import rasterio

OFFSETS = [(p, q) for q in (-3, -1, 1, 3) for p in (-3, -1, 1, 3)]


def rounded(values, step):
    """The nearest whole number of steps."""
    return np.sign(values) * ((np.abs(values) + (step - 1) // 2) // step)


def new_points(size, odd, half):
    """Rows and columns of the points that a step adds: centres of squares, or of their sides."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    if odd:
        chosen = (x % half == 0) & (y % half == 0) & ((x // half + y // half) % 2 == 1)
    else:
        chosen = (x % (2 * half) == half) & (y % (2 * half) == half)
    return np.nonzero(chosen)


def neighbours(field, ys, xs, offsets):
    """The field at offsets from each point, mirrored at the border."""
    last = field.shape[0] - 1

    def mirrored(i):
        i = np.abs(i)
        return np.where(i > last, 2 * last - i, i)

    return np.stack([field[mirrored(ys + dy), mirrored(xs + dx)] for dx, dy in offsets], 1)


def old_offsets(odd, half):
    """Where the sixteen old points around a new one lie."""
    if odd:
        return [((p + q) // 2 * half, (p - q) // 2 * half) for p, q in OFFSETS]
    return [(p * half, q * half) for p, q in OFFSETS]


def earlier_offsets(odd, half):
    """New points of the same step that come earlier: the row's neighbour first, then three of the row below."""
    if odd:
        return [(-2 * half, 0), (-half, -half), (half, -half), (0, -2 * half)]
    return [(-2 * half, 0), (0, -2 * half), (-2 * half, -2 * half), (2 * half, -2 * half)]


def entropy(numbers, classes):
    """Bits of all numbers, each class having the table of its own."""
    bits = 0.0
    for each in np.unique(classes):
        _, counts = np.unique(numbers[classes == each], return_counts=True)
        bits -= (counts * np.log2(counts / counts.sum())).sum()
    return bits


def fit(parts, values):
    return np.linalg.lstsq(parts, values, rcond=None)[0]


def neville():
    """(10 * the nearest four - the next eight) / 32."""
    distance = np.array([p * p + q * q for p, q in OFFSETS])
    return np.where(distance == 2, 10 / 32, np.where(distance == 10, -1 / 32, 0.0))


def measure(heights, error, learns, causal, contexts):
    """Bits a sample for one set of choices."""
    step = 2 * error + 1
    size = heights.shape[0]
    have = rounded(heights, step) * step
    missed, numbers = np.zeros(heights.shape), np.zeros(heights.shape)
    bits, count, half = 0.0, 0, 16
    while half:
        for odd in (False, True):
            ys, xs = new_points(size, odd, half)
            old = neighbours(have, ys, xs, old_offsets(odd, half)).astype(float)
            truth = heights[ys, xs].astype(float)
            mean = old[:, [5, 6, 9, 10]].mean(1, keepdims=True)
            guess = mean[:, 0] + (old - mean) @ (fit(old - mean, truth - mean[:, 0]) if learns else neville())
            earlier = earlier_offsets(odd, half)
            missed[ys, xs] = truth - guess
            if causal:
                before = neighbours(missed, ys, xs, earlier)
                guess = guess + before @ fit(before, truth - guess)
            guess = np.rint(guess).astype(np.int64)
            number = rounded(heights[ys, xs] - guess, step)
            have[ys, xs] = guess + number * step
            numbers[ys, xs] = np.abs(number)
            bits += entropy(number, classes_of(old / step, neighbours(numbers, ys, xs, earlier), number, contexts))
            count += len(ys)
        half //= 2
    return bits / count


def classes_of(old, near, number, contexts):
    """Two classes an octave of the activity, which is fitted to the magnitudes."""
    square = old.reshape(-1, 4, 4)
    a, b, d, c = square[:, 1, 1], square[:, 1, 2], square[:, 2, 1], square[:, 2, 2]
    bends = sum(
        np.abs(2 * square[:, j, i] - square[:, j - 1, i] - square[:, j + 1, i])
        + np.abs(2 * square[:, j, i] - square[:, j, i - 1] - square[:, j, i + 1])
        for j in (1, 2)
        for i in (1, 2)
    )
    parts = [np.abs(a + c - b - d), bends, np.abs(a - c) + np.abs(b - d), np.ones(len(old))]
    if contexts != "old":
        parts.append(2 * near[:, 1] + near[:, 2] + near[:, 3])
    if contexts == "all":
        parts.append(near[:, 0])
    parts = np.stack(parts, 1)
    activity = parts @ fit(parts, np.minimum(np.abs(number), 8))
    return np.floor(2 * np.log2(np.maximum(activity, 1 / 256))).astype(int)


CHOICES = [
    ("fixed kernel; classes from old points", False, False, "old"),
    ("kernel learnt by level", True, False, "old"),
    ("... and what earlier new points missed", True, True, "old"),
    ("... classes from the row below, too (the codec's)", True, True, "below"),
    ("... and from the neighbour in the row", True, True, "all"),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dems", nargs="+", metavar="DEM", help="square rasters of whole metres, 2^k + 1 a side")
    parser.add_argument("--errors", default="1,5", help="maximum errors in metres, with commas between")
    arguments = parser.parse_args()
    errors = [int(e) for e in arguments.errors.split(",")]
    heads = [f"{dem.split('/')[-1].split('.')[0]}, {error} m" for dem in arguments.dems for error in errors]
    print("| choice | " + " | ".join(heads) + " |\n|---|" + "---|" * len(heads))
    fields = [rasterio.open(dem).read(1).astype(np.int64) for dem in arguments.dems]
    for name, *choice in CHOICES:
        found = [measure(field, error, *choice) for field in fields for error in errors]
        print(f"| {name} | " + " | ".join(f"{bits:.3f}" for bits in found) + " |", flush=True)


if __name__ == "__main__":
    main()
