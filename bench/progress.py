"""What a prefix of a stream costs beyond a store that is made for its error alone.

A store is built and its stream cut where the surface is, for the first time, within each of some errors of every
sample. Beside its bytes stand those of a store built for just the error reached: payloads and index of both.
"""

import argparse
import csv
import json
import subprocess
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ERRORS = (60, 40, 25, 16, 8, 4, 1)


class Stores:
    """Builds stores of one DEM."""

    def __init__(self, program: Path, dem: Path, folder: Path):
        self.program, self.dem, self.folder = program, dem, folder
        self.known: dict[int, int] = {}

    def build(self, error: int) -> Path:
        """A store whose surface is within `error` metres of every sample."""
        store = self.folder / f"store-{error}"
        if not store.exists():
            self._run("build", self.dem, "-o", store, "--crs", "source", "--max-error", error)
        return store

    def bytes(self, error: int) -> int:
        """What such a store takes."""
        if error not in self.known:
            report = json.loads(self._run("inspect", self.build(error), "--json"))
            layer = report["layers"][0]
            self.known[error] = layer["point_bytes"] + layer["index_bytes"]
        return self.known[error]

    def curve(self, error: int) -> list[dict[str, float]]:
        """Bytes and true errors of the prefixes of such a store's stream."""
        table = self.folder / "curve.csv"
        self._run("inspect", self.build(error), "--curve", table)
        with table.open() as lines:
            rows = list(csv.DictReader(lines))
        # A lossy store's curve is measured from its finest surface, which is within `error` of the samples.
        return [
            {
                "bytes": int(row["bytes"]),
                "max": float(row["max_error_m"]) + error,
                "rms": float(row["rms_error_m"]),
            }
            for row in rows
        ]

    def _run(self, *arguments: object) -> str:
        command = [str(self.program), *(str(a) for a in arguments)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            raise SystemExit(done.stderr.strip())
        return done.stdout


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dems", nargs="+", type=Path, help="DEMs in whole metres")
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/diamantina-server")
    arguments = parser.parse_args()
    print("| DEM | store | error asked | error reached | RMS | bytes of the prefix | of a store for it | ratio |")
    print("|---|---|---|---|---|---|---|---|")
    for dem in arguments.dems:
        with tempfile.TemporaryDirectory() as folder:
            stores = Stores(arguments.program, dem, Path(folder))
            for base in (0, 1):
                curve = stores.curve(base)
                for asked in (e for e in ERRORS if e >= base):
                    row = next((row for row in curve if row["max"] <= asked + 1e-9), curve[-1])
                    direct = stores.bytes(int(row["max"]))
                    print(
                        f"| {dem.stem} | {base} m | {asked} m | {row['max']:.1f} m | {row['rms']:.2f} m | "
                        f"{row['bytes']} | {direct} | {row['bytes'] / direct:.2f} |"
                    )


if __name__ == "__main__":
    main()
