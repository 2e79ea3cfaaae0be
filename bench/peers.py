"""Bytes, bounds and speed of this project's `points` beside what else a user could store heights with.

Prints Markdown tables for docs/BENCHMARKS.md; `--json` and `--csv` write every figure. Run it through
scripts/bench-peers, which installs what it needs. Peers' figures are kept in target/bench-peers.
"""

import argparse
import csv
import json
import os
import sys
import time
from pathlib import Path

import imagecodecs as ic
import numpy as np

import measure
import tables
from coders import CODECS, Codec, Scale
from dems import DATASETS_FIRST, Dem, all_dems
from ours import Ours, bench_speed

ROOT = Path(__file__).resolve().parent.parent
METRES = (1.0, 5.0, 16.0)
# Where whole metres are much of the relief, parts of it that are as fine as 1, 5 and 16 m of 4000 m.
PARTS = (4000, 800, 250)


def errors_of(dem: Dem, unit: float, asked: list[float] | None) -> dict[float, str]:
    """Maximum errors and what to call them: metres unless they are over a twentieth of the relief; parts of
    the relief where that is less than 800 m. Those that mean the same whole units are left out."""
    if asked:
        return {error: f"{error:g} m" for error in asked}
    found = {error: f"{error:g} m" for error in METRES if error <= dem.relief / 20}
    if dem.relief < 800:
        for part in PARTS:
            error = float(f"{dem.relief / part:.2g}")
            found.setdefault(error, f"{error:g} m = relief / {part}")
    seen, kept = set(), {}
    for error in sorted(found):
        whole = np.floor(error / unit + 1e-9) if unit > 0 else error
        if whole not in seen:
            seen.add(whole)
            # Less than a unit of the source leaves no choice.
            kept[error] = found[error] if whole > 0 else f"{error:g} m: lossless"
    return kept


def unit_of(dem: Dem, quantum: float) -> float:
    """The unit of which all heights are multiples, 0 if there is none: the quantum our builder found, if it
    is true of what GDAL read."""
    heights = dem.heights[dem.valid]
    off = np.abs(heights / quantum - np.rint(heights / quantum)).max()
    return quantum if off < 0.01 else 0.0


def measure_all(arguments, cache, ours: Ours, dems: list[Dem]) -> list[dict]:
    """A row for every DEM, error, layout and peer, and for us: cheap peers of all DEMs first."""
    rows, plans = [], []
    for dem in dems:
        lossless = ours.build(dem, 0.0)
        if "why" in lossless:
            say(f"{dem.name}: left out: {lossless['why']}")
            continue
        unit = unit_of(dem, lossless["quantum"])
        errors = errors_of(dem, unit, arguments.errors)
        plans.append((dem, unit, errors))
        for error, label in errors.items():
            figure = ours.build(dem, error)
            say(f"{dem.name} {label}: ours {bits(figure, dem)}")
            rows.append(row(dem, error, label, "diamantina", "whole", figure))
        dem.release()
    for cost in range(3):
        for dem, unit, errors in plans:
            for error, label in errors.items():
                for codec in CODECS:
                    if codec.cost == cost and (not codec.few or dem.name in DATASETS_FIRST):
                        peer_rows(rows, arguments, cache, dem, codec, error, unit, label)
            dem.release()
    return rows


def peer_rows(rows, arguments, cache, dem, codec, error, unit, label) -> None:
    for layout in measure.LAYOUTS:
        fetch_only = arguments.ours_only or codec.cost > arguments.cost
        started = time.perf_counter()
        figure = measure.peer(cache, dem, codec, error, unit, layout, fetch_only)
        taken = time.perf_counter() - started
        if figure is not None:
            if taken > 1:
                say(f"{dem.name} {label} {layout}: {codec.name} {bits(figure, dem)} ({taken:.0f} s)")
            rows.append(row(dem, error, label, codec.name, layout, figure))


def row(dem: Dem, error: float, label: str, codec: str, layout: str, figure: dict) -> dict:
    size = figure.get("bytes")
    found = {"dem": dem.name, "file": dem.file, "samples": dem.samples, "error": error, "label": label}
    found |= {"codec": codec, "layout": layout, "bits": 8 * size / dem.samples if size is not None else None}
    return found | {"true_error": figure.get("error"), **{k: v for k, v in figure.items() if k != "error"}}


def bits(figure: dict, dem: Dem) -> str:
    return f"{8 * figure['bytes'] / dem.samples:.3f}" if "bytes" in figure else figure["why"]


def speeds(ours: Ours, dems: list[Dem], errors: list[float]) -> list[dict]:
    """Millions of samples a second of CPU time, of our decoder and each peer's, the best of several runs."""
    rows = []

    def add(dem: Dem, error: float, codec: str, layout: str, rate: float) -> None:
        found = {"dem": dem.name, "error": error, "codec": codec, "layout": layout}
        rows.append(found | {"decode_msamples_per_second": rate})
        say(f"{dem.name} {error:g} m {layout}: {codec} decodes {rate:.1f} Msamples/s")

    for dem in [dem for dem in dems if dem.name in DATASETS_FIRST]:
        for error in errors:
            add(dem, error, tables.OURS, "whole", ours.decode_speed(dem, error))
            scale = Scale.of(dem.heights, 1.0, error)
            for codec in [codec for codec in CODECS if codec.cost < 2]:
                for layout in measure.LAYOUTS:
                    seconds = best_run(dem, codec, scale, layout)
                    if seconds:
                        add(dem, error, codec.name, layout, dem.samples / seconds / 1e6)
    return rows


def best_run(dem: Dem, codec: Codec, scale: Scale, layout: str) -> float | None:
    filled = dem.filled("smooth")
    pieces = [
        measure.Piece(np.ascontiguousarray(filled[w]), dem.valid[w], scale)
        for w in measure.windows(filled.shape, measure.LAYOUTS[layout])
    ]
    try:
        coded = [codec.encode(piece, scale.error) for piece in pieces]
    except ValueError:
        return None
    decode, best = codec.raw or codec.decode, float("inf")
    for _ in range(5):
        # CPU time, of all threads: others use the machine, too.
        started = time.process_time()
        for data, piece in zip(coded, pieces):
            decode(data, piece)
        best = min(best, time.process_time() - started)
    return best


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--data", type=Path, help="folder of DEMs [default: DIAMANTINA_DATA, else ../shared/data]"
    )
    parser.add_argument("--only", help="names of DEMs, with commas between")
    parser.add_argument(
        "--errors", help="maximum errors in metres, with commas between, instead of each DEM's own"
    )
    parser.add_argument(
        "--ours-only", action="store_true", help="measure only ours; of peers show what is kept"
    )
    parser.add_argument(
        "--cost",
        type=int,
        default=2,
        choices=range(3),
        help="measure the fast peers (0), JPEG XL at effort 9, too (1), WebP, too (2)",
    )
    parser.add_argument("--speed", action="store_true", help="also time decoders, ours with cargo bench")
    parser.add_argument("--tins", action="store_true", help="also count triangles of simplifiers")
    parser.add_argument("--program", type=Path, help="our server's program [default: target/release]")
    parser.add_argument("--json", type=Path, help="write every figure here")
    parser.add_argument("--csv", type=Path, help="write every figure here")
    arguments = parser.parse_args()
    arguments.errors = [float(e) for e in arguments.errors.split(",")] if arguments.errors else None
    return arguments


def main() -> None:
    arguments = parse()
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    folder = arguments.data or Path(os.environ.get("DIAMANTINA_DATA", ROOT.parent / "shared" / "data"))
    if not (folder / "MANIFEST.tsv").exists():
        raise SystemExit(f"{folder}: no MANIFEST.tsv there. Name the folder of DEMs with DIAMANTINA_DATA")
    dems = all_dems(folder)
    if arguments.only:
        names = arguments.only.split(",")
        if unknown := set(names) - {dem.name for dem in dems}:
            known = ", ".join(dem.name for dem in dems)
            raise SystemExit(f"no DEM is named {', '.join(sorted(unknown))}; there are {known}")
        dems = [dem for dem in dems if dem.name in names]
    cache = measure.Cache(target / "bench-peers" / "figures.jsonl")
    program = arguments.program or target / "release" / "diamantina-server"
    ours = Ours(program, target / "bench-peers")
    result = {"versions": ic.version(), "figures": measure_all(arguments, cache, ours, dems)}
    if arguments.speed:
        result["bench"] = bench_speed(ROOT)
        result["speeds"] = speeds(ours, dems, arguments.errors or list(METRES))
    if arguments.tins:
        import simplifiers

        result["tins"] = simplifiers.measure(cache, dems)
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")
    if arguments.csv:
        write_csv(arguments.csv, result["figures"])
    print(tables.all_tables(result))


def write_csv(path: Path, rows: list[dict]) -> None:
    names = list(dict.fromkeys(name for found in rows for name in found))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
