"""The DEMs: which there are, their heights as one array, and the same without holes.

`Dem.heights` is float64 in metres with NaN where there is no height. It is read with GDAL (through
rasterio), never with the reader of this project, so that a mistake there would show: the counts of
samples that have a height are compared with those of our own build.
"""

import csv
import gzip
import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window
from scipy import ndimage

# What files do not say: metres of a cell (PNG) and metres of one unit of height.
OPTIONS = {
    "puget_1k/ps_height_1k.png": {"cell": 160.0, "height_scale": 0.1},
    "gcanyon/gcanyon_elev_crop.bw.png": {"cell": 60.0, "height_scale": 10.0},
}
# Of rasters too large for the slowest peers, the square in the middle of this many samples a side.
CROPS = {"moon/moon_sw_8193.tif": 2049}
# Short names, where the file's own does not serve.
NAMES = {
    "srtm3_crops/alps_1025.tif": "alps",
    "srtm3_crops/hills_1025.tif": "hills",
    "bigtujunga/bigtujunga.tif": "bigtujunga",
    "cairns/cairns.zip": "cairns",
    "gcanyon/gcanyon_elev_crop.bw.png": "gcanyon",
    "hilo/hilo_grid_1_3_arsec.tif": "hilo",
    "jacksboro/jacksboro.tif": "jacksboro",
    "malstroem/depths.tif": "malstroem-depths",
    "malstroem/dtm.tif": "malstroem-dtm",
    "malstroem/filled.tif": "malstroem-filled",
    "merewether/topography1.asc": "merewether",
    "monai/Benchmark_2_Bathymetry.asc": "monai-asc",
    "monai/Monai_bathymetry.tif": "monai",
    "moon/moon_sw_8193.tif": "moon",
    "okushiri/HNO1993.tif": "okushiri-HNO1993",
    "okushiri/OK03.tif": "okushiri-OK03",
    "okushiri/OK24.tif": "okushiri-OK24",
    "osgearth_terrain/mt_fuji_90m.tif": "fuji",
    "osgearth_terrain/mt_rainier_90m.tif": "rainier",
    "puget_1k/ps_height_1k.png": "puget",
    "qgis_training/SRTM.tif": "capetown",
    "riorgbify/elev.tif": "sanfrancisco",
    "srtm1_patagonia/S46W066.hgt.gz": "patagonia",
    "srtm3_geotiff/N46E008.tif": "N46E008",
    "srtm3_nh/N44W072.hgt.gz": "whitemountains",
    "srtm3_ventoux/N44E005.hgt": "ventoux",
    "sthelens_dome/1_msh00_83.tif": "sthelens-crater",
    "sthelens_dome/4_msh1013_83.tif": "sthelens-dome",
    "sthelens_vtk/SainteHelens.dem": "sthelens",
    "vanderford/GA4886_VanderfordGlacier_2022_EGM2008_64m-epsg3031.cog": "vanderford",
}
DATASETS_FIRST = ["alps", "hills"]


@dataclass
class Dem:
    """One DEM. Its arrays are read when first used."""

    name: str
    file: str
    path: Path
    nodata: float | None
    options: dict = field(default_factory=dict)
    crop: int | None = None
    _heights: np.ndarray | None = None
    _filled: dict = field(default_factory=dict)
    _hash: str | None = None

    @property
    def heights(self) -> np.ndarray:
        """Metres, rows from the north, NaN where there is no height."""
        if self._heights is None:
            self._heights = self._read()
        return self._heights

    @property
    def valid(self) -> np.ndarray:
        return np.isfinite(self.heights)

    @property
    def samples(self) -> int:
        """How many samples have a height: what all bits per sample are divided by."""
        return int(np.count_nonzero(self.valid))

    @property
    def relief(self) -> float:
        return float(np.nanmax(self.heights) - np.nanmin(self.heights))

    @property
    def fills(self) -> list[str]:
        """Ways of filling holes worth trying, for codecs that know no holes: the best counts."""
        share = self.samples / self.heights.size
        return (
            ["smooth"]
            if share > 0.99
            else ["smooth", "nearest"]
            if share > 0.5
            else ["smooth", "nearest", "hold"]
        )

    def filled(self, way: str) -> np.ndarray:
        """The heights without holes."""
        if way not in self._filled:
            self._filled[way] = fill(self.heights, way)
        return self._filled[way]

    @property
    def hash(self) -> str:
        """Of the file and of how it is read: what cached figures are kept under."""
        if self._hash is None:
            digest = hashlib.sha256(self.path.read_bytes())
            digest.update(repr((self.nodata, sorted(self.options.items()), self.crop)).encode())
            self._hash = digest.hexdigest()[:16]
        return self._hash

    def release(self) -> None:
        """Drops the arrays."""
        self._heights, self._filled = None, {}

    def source(self, work: Path) -> Path:
        """The file for our own builder: the DEM itself, or its crop as a GeoTIFF in `work`."""
        if self.crop is None:
            return self.path
        out = work / f"{self.name}_{self.crop}.tif"
        if not out.exists():
            work.mkdir(parents=True, exist_ok=True)
            data, cell = self._raw(), self._cell()
            part = work / f"{self.name}_{os.getpid()}.tif"
            # Without a CRS: ours would otherwise have to know this body's.
            transform = rasterio.Affine(cell, 0.0, 0.0, 0.0, -cell, data.shape[0] * cell)
            profile = {"driver": "GTiff", "count": 1, "dtype": data.dtype, "transform": transform}
            height, width = data.shape
            with rasterio.open(part, "w", width=width, height=height, nodata=self.nodata, **profile) as file:
                file.write(data, 1)
            part.rename(out)
        return out

    def _cell(self) -> float:
        with rasterio.open(self.path) as file:
            return float(file.transform.a)

    def _raw(self) -> np.ndarray:
        if self.path.name.endswith(".hgt.gz"):
            raw = np.frombuffer(gzip.decompress(self.path.read_bytes()), dtype=">i2").astype(np.int16)
            side = int(round(raw.size**0.5))
            return raw.reshape(side, side)
        name = f"/vsizip/{self.path}" if self.path.suffix == ".zip" else str(self.path)
        with rasterio.open(name) as file:
            window = None
            if self.crop is not None:
                left, top = (file.width - self.crop) // 2, (file.height - self.crop) // 2
                window = Window(left, top, self.crop, self.crop)
            return file.read(1, window=window)

    def _read(self) -> np.ndarray:
        raw = self._raw()
        heights = raw.astype(np.float64)
        if self.nodata is not None:
            heights[raw == np.asarray(self.nodata).astype(raw.dtype)] = np.nan
        heights[~np.isfinite(heights)] = np.nan
        return heights * self.options.get("height_scale", 1.0)


def all_dems(folder: Path) -> list[Dem]:
    """Every DEM of the manifest, the two crops first; imagery and side files left out."""
    found = []
    with open(folder / "MANIFEST.tsv", newline="") as file:
        for row in csv.DictReader(file, delimiter="\t"):
            name = row["file"]
            if not row["dtype"] or "IMAGERY" in (row["note"] or "") or not (folder / name).exists():
                continue
            nodata = row["nodata"]
            found.append(
                Dem(
                    name=NAMES.get(name, Path(name).stem),
                    file=name,
                    path=folder / name,
                    nodata=float(nodata) if nodata not in ("", "-", None) else None,
                    options=OPTIONS.get(name, {}),
                    crop=CROPS.get(name),
                )
            )
    rank = {name: place for place, name in enumerate(DATASETS_FIRST)}
    return sorted(found, key=lambda dem: rank.get(dem.name, len(rank)))


def fill(heights: np.ndarray, way: str) -> np.ndarray:
    """Holes filled: `smooth`, from ever coarser means; `nearest`, from the nearest sample; `hold`, from the
    last one in the row, which costs predictors nothing."""
    valid = np.isfinite(heights)
    if valid.all():
        return heights
    if way == "smooth":
        return _fill_smooth(heights, valid)
    rows, columns = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    nearest = heights[rows, columns]
    if way == "nearest":
        return nearest
    last = np.maximum.accumulate(np.where(valid, np.arange(heights.shape[1]), 0), axis=1)
    held = np.take_along_axis(heights, last, axis=1)
    return np.where(np.isfinite(held), held, nearest)


def _fill_smooth(heights: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Each level of a pyramid holds the mean of the valid ones of four; holes take the level above, between
    its samples."""
    levels = [np.where(valid, heights, 0.0)]
    weights = [valid.astype(np.float64)]
    while max(levels[-1].shape) > 1:
        sums, counts = _halve(levels[-1] * weights[-1]), _halve(weights[-1])
        levels.append(np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0))
        weights.append((counts > 0).astype(np.float64))
    above = levels[-1]
    for values, weight in zip(reversed(levels[:-1]), reversed(weights[:-1])):
        above = np.where(weight > 0, values, _double(above, values.shape))
    return above


def _halve(a: np.ndarray) -> np.ndarray:
    padded = np.pad(a, ((0, a.shape[0] % 2), (0, a.shape[1] % 2)))
    return padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]


def _double(a: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Bilinear, samples in the middle of their cells."""
    for axis in (0, 1):
        at = np.clip((np.arange(shape[axis]) - 0.5) / 2.0, 0, a.shape[axis] - 1)
        low = np.floor(at).astype(int)
        high = np.minimum(low + 1, a.shape[axis] - 1)
        part = (at - low).reshape((-1, 1) if axis == 0 else (1, -1))
        a = np.take(a, low, axis) * (1 - part) + np.take(a, high, axis) * part
    return a
