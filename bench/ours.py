"""Our own figures, from the release program: always measured, never kept."""

import json
import re
import subprocess
import tempfile
from pathlib import Path

from dems import Dem


class Ours:
    """The program under `target`, and a folder for the stores it makes."""

    def __init__(self, program: Path, work: Path):
        self.program, self.work = program, work
        if not program.exists():
            raise SystemExit(
                f"{program}: not found. Build it: cargo build --release --locked -p diamantina-server"
            )

    def build(self, dem: Dem, error: float) -> dict:
        """Bytes of a store: all payloads of all levels, and the index apart. Every blob is decoded once more
        by `inspect --verify`. `why` instead, where the program refuses."""
        self.work.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self.work) as folder:
            return self._build(dem, error, Path(folder) / "store")

    def _build(self, dem: Dem, error: float, store: Path) -> dict:
        command = [str(self.program), "build", str(dem.source(self.work)), "--crs", "source"]
        command += ["--max-error", repr(error), "-o", str(store), "--json"]
        for name, value in dem.options.items():
            command += [f"--{name.replace('_', '-')}", repr(value)]
        if dem.nodata is not None:
            command += [f"--nodata={dem.nodata!r}"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            return {"why": done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "failed"}
        report = json.loads(done.stdout)
        layer = report["scene"]["layers"][0]
        if layer["valid_samples"] != dem.samples:
            raise SystemExit(f"{dem.file}: {layer['valid_samples']} samples for us, {dem.samples} for GDAL")
        verify = [str(self.program), "inspect", str(store), "--verify", "--json"]
        subprocess.run(verify, check=True, capture_output=True)
        return {
            "bytes": report["point_bytes"],
            "index_bytes": report["index_bytes"],
            "error": layer["finest_error"],
            "quantum": layer["quantum"],
            "diamonds": report["diamonds"],
            "build_msamples_per_second": report["msamples_per_second"],
        }


def decode_speed(root: Path) -> dict[str, float]:
    """Msamples/s of `cargo bench`'s points/decode, by name."""
    command = ["cargo", "bench", "--locked", "-p", "diamantina-protocol", "--", "points/decode"]
    text = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    speeds, name = {}, None
    for line in text.splitlines():
        if found := re.match(r"(points/decode/\S+)", line):
            name = found[1]
        # The middle of low, middle, high.
        if name and (found := re.search(r"thrpt:\s+\[\S+ \S+ (\S+) ([MKG])elem/s", line)):
            speeds[name] = float(found[1]) * {"K": 1e-3, "M": 1.0, "G": 1e3}[found[2]]
            name = None
    return speeds
