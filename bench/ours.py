"""Our own figures, from the release program: always measured, never kept."""

import json
import re
import resource
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
        with self._folder() as folder:
            store = Path(folder) / "store"
            done = subprocess.run(self._command(dem, error, store), capture_output=True, text=True)
            if done.returncode != 0:
                return {"why": (done.stderr.strip().splitlines() or ["failed without a word"])[-1]}
            report = json.loads(done.stdout)
            self._inspect(store, "--verify")
        layer = report["scene"]["layers"][0]
        if layer["valid_samples"] != dem.samples:
            raise SystemExit(f"{dem.file}: {layer['valid_samples']} samples for us, {dem.samples} for GDAL")
        return {
            "bytes": report["point_bytes"],
            "index_bytes": report["index_bytes"],
            "error": layer["finest_error"],
            "quantum": layer["quantum"],
            "diamonds": report["diamonds"],
            "build_msamples_per_second": report["msamples_per_second"],
        }

    def decode_speed(self, dem: Dem, error: float) -> float:
        """Msamples/s of CPU time, all levels: what `inspect --verify` takes beyond `inspect`, so reading and
        checksums are in it."""
        with self._folder() as folder:
            store = Path(folder) / "store"
            subprocess.run(self._command(dem, error, store), check=True, capture_output=True)
            best = {
                option: min(self._inspect(store, *option) for _ in range(7)) for option in ((), ("--verify",))
            }
        return dem.samples / max(best["--verify",] - best[()], 1e-9) / 1e6

    def _folder(self) -> tempfile.TemporaryDirectory:
        self.work.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryDirectory(dir=self.work)

    def _command(self, dem: Dem, error: float, store: Path) -> list[str]:
        return build_command(self.program, dem, error, store, self.work)

    def _inspect(self, store: Path, *options: str) -> float:
        """Seconds of CPU time."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([str(self.program), "inspect", str(store), *options], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def build_command(program: Path, dem: Dem, error: float, store: Path, work: Path) -> list[str]:
    """How our builder is called for a DEM, with what the file does not say."""
    command = [str(program), "build", str(dem.source(work)), "--crs", "source"]
    command += ["--max-error", repr(error), "-o", str(store), "--json"]
    for name, value in dem.options.items():
        command += [f"--{name.replace('_', '-')}", repr(value)]
    return command if dem.nodata is None else [*command, f"--nodata={dem.nodata!r}"]


def bench_speed(root: Path) -> dict[str, float]:
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
