"""Ground and a water surface over it, as large as the field of the paper on water: land.tif and sea.tif.

    python bench/two_layers.py DEM [--size 3921x2431] [--level 650] -o FOLDER

The ground is the DEM, interpolated; the water has waves of 8 m about a level. Needs numpy and rasterio, as
bench/requirements.txt names them. Then

    diamantina-server build FOLDER/land.tif --layer sea=water:FOLDER/sea.tif --encoding points,tin --max-error 1 -o STORE
"""

import argparse
import pathlib

import numpy as np
import rasterio
from rasterio.enums import Resampling
from rasterio.transform import Affine


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dem")
    parser.add_argument("--size", default="3921x2431")
    parser.add_argument("--level", type=float, default=650)
    parser.add_argument("-o", "--output", type=pathlib.Path, required=True)
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    options.output.mkdir(parents=True, exist_ok=True)
    with rasterio.open(options.dem) as source:
        ground = source.read(1, out_shape=(height, width), resampling=Resampling.cubic)
        place = source.transform * Affine.scale(source.width / width, source.height / height)
        profile = dict(driver="GTiff", width=width, height=height, count=1, crs=source.crs, transform=place,
                       compress="deflate", tiled=True)
    with rasterio.open(options.output / "land.tif", "w", dtype="int16", predictor=2, **profile) as land:
        land.write(ground.astype("int16"), 1)
    y, x = np.mgrid[0:height, 0:width]
    waves = 6 * np.sin(x / 170) * np.cos(y / 230) + 2 * np.sin((x + 2 * y) / 47)
    water = np.round(10 * (options.level + waves)) / 10
    with rasterio.open(options.output / "sea.tif", "w", dtype="float32", predictor=3, **profile) as sea:
        sea.write(water.astype("float32"), 1)


if __name__ == "__main__":
    main()
