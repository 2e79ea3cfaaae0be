"""Figures as Markdown."""

from dems import DATASETS_FIRST

OURS = "diamantina"
# The goals: our bits against a peer's, of the whole raster, from an error in metres (or its like in parts of
# the relief) up; and against the best peer's independent tiles.
GOALS = [("SZ3", "whole", 0, 0.85), ("JPEG XL effort 9", "whole", 1, 0.95), ("SPERR", "whole", 1, 0.95)]
GOAL_TILES = 0.75


def all_tables(result: dict) -> str:
    figures = result["figures"]
    names = list(dict.fromkeys(row["dem"] for row in figures))
    parts = [crop_table(figures, name) for name in names if name in DATASETS_FIRST]
    parts += [every_dem(figures, names), worst(figures, names), breaches(figures)]
    if "speeds" in result:
        parts.append(speed_table(result))
    if "tins" in result:
        parts.append(tin_table(result["tins"]))
    parts.append(f"Versions: {versions(result['versions'])}.")
    return "\n\n".join(part for part in parts if part)


def find(figures: list[dict], dem: str, error: float, codec: str, layout: str) -> dict | None:
    for row in figures:
        if (row["dem"], row["error"], row["codec"], row["layout"]) == (dem, error, codec, layout):
            return row if row["bits"] is not None else None
    return None


def errors_of(figures: list[dict], dem: str) -> dict[float, str]:
    return {row["error"]: row["label"] for row in figures if row["dem"] == dem}


def best(figures: list[dict], dem: str, error: float, layout: str) -> dict | None:
    """The peer with the fewest bits."""
    rows = [
        row
        for row in figures
        if (row["dem"], row["error"], row["layout"]) == (dem, error, layout)
        and row["codec"] != OURS
        and row["bits"] is not None
    ]
    return min(rows, key=lambda row: row["bits"], default=None)


def crop_table(figures: list[dict], dem: str) -> str:
    """Every peer, error and layout of one DEM."""
    errors = errors_of(figures, dem)
    codecs = list(
        dict.fromkeys(row["codec"] for row in figures if row["dem"] == dem and row["codec"] != OURS)
    )
    lines = [f"**{dem}**, bits a sample at maximum error " + " / ".join(errors.values()), ""]
    lines += ["| | whole raster | tiles of 256² | tiles of 64² |", "|---|---|---|---|"]
    ours = [find(figures, dem, error, OURS, "whole") for error in errors]
    if all(ours):
        plain = " / ".join(f"{row['bits']:.3f}" for row in ours)
        index = " / ".join(f"{8 * (row['bytes'] + row['index_bytes']) / row['samples']:.3f}" for row in ours)
        lines.append(
            f"| **diamantina**, all levels, every diamond by itself | **{plain}** | the same | the same |"
        )
        lines.append(f"| … with its index | {index} | the same | the same |")
    for codec in codecs:
        cells = []
        for layout in ("whole", "256", "64"):
            rows = [find(figures, dem, error, codec, layout) for error in errors]
            cells.append(" / ".join(f"{row['bits']:.3f}" if row else "–" for row in rows))
        lines.append(f"| {codec} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def every_dem(figures: list[dict], names: list[str]) -> str:
    """A line for each DEM and error."""
    lines = ["Bits a sample, and ours divided by the peer's in brackets:", ""]
    lines += [
        "| DEM | maximum error | diamantina | with index | SZ3 | SZ3, rounded | JPEG XL e9 | SPERR "
        "| SPERR, rounded | best peer's 256² tiles | best peer's 64² tiles |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for dem in names:
        for error, label in errors_of(figures, dem).items():
            ours = find(figures, dem, error, OURS, "whole")
            if ours is None:
                why = next(row for row in figures if row["dem"] == dem and row["error"] == error)
                lines.append(f"| {dem} | {label} | {why.get('why', 'refused')} | | | | | | | | |")
                continue
            cells = [dem, label, f"{ours['bits']:.3f}"]
            cells.append(f"{8 * (ours['bytes'] + ours['index_bytes']) / ours['samples']:.3f}")
            for codec in ("SZ3", "SZ3, rounded", "JPEG XL effort 9", "SPERR", "SPERR, rounded"):
                cells.append(against(ours, find(figures, dem, error, codec, "whole")))
            for layout in ("256", "64"):
                row = best(figures, dem, error, layout)
                cells.append(against(ours, row) + (f" {row['codec']}" if row else ""))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def against(ours: dict, row: dict | None) -> str:
    return f"{row['bits']:.3f} ({ours['bits'] / row['bits']:.2f})" if row else "–"


def worst(figures: list[dict], names: list[str]) -> str:
    """The largest ratio for each goal, and how many miss it."""
    lines = ["| ours against | goal | worst | where | met |", "|---|---|---|---|---|"]
    peers = [
        (codec, layout, first, goal, f"{codec}, whole raster" + (", 5 m and above" if first else ""))
        for codec, layout, first, goal in GOALS
    ]
    peers.append((None, "64", 0, GOAL_TILES, "best peer's independent 64² tiles"))
    for codec, layout, first, goal, label in peers:
        found = []
        for dem in names:
            errors = errors_of(figures, dem)
            for error, name in errors.items():
                if first and not coarse(name, error):
                    continue
                ours = find(figures, dem, error, OURS, "whole")
                row = find(figures, dem, error, codec, layout) if codec else best(figures, dem, error, layout)
                if ours and row:
                    found.append((ours["bits"] / row["bits"], dem, name))
        if found:
            ratio, dem, name = max(found)
            met = sum(r <= goal for r, _, _ in found)
            lines.append(f"| {label} | {goal} | {ratio:.3f} | {dem}, {name} | {met} of {len(found)} |")
    return "\n".join(lines)


def coarse(label: str, error: float) -> bool:
    """5 m and above, or their like."""
    if "lossless" in label or "relief / 4000" in label:
        return False
    return "relief" in label or error >= 5


def breaches(figures: list[dict]) -> str:
    """Peers that break the bound they were asked for."""
    lines = []
    for codec in dict.fromkeys(row["codec"] for row in figures):
        over = [
            row
            for row in figures
            if row["codec"] == codec
            and row.get("error_as_asked") is not None
            and row["error_as_asked"] > row["error"] * (1 + 1e-9) + 1e-9
        ]
        if over:
            worst_row = max(over, key=lambda row: row["error_as_asked"] / row["error"])
            true, asked = worst_row["error_as_asked"], worst_row["error"]
            where = f"{worst_row['dem']}, {worst_row['layout']}"
            lowest = min(row.get("factor", 0) for row in over)
            lines.append(
                f"| {codec} | {len(over)} | {true:.6g} m, asked {asked:g} m ({where}) | {lowest:g} |"
            )
    head = [
        "Peers whose true error was above what was asked; their tolerance was lowered until it held:",
        "",
        "| peer | times | worst | lowest factor on the tolerance |",
        "|---|---|---|---|",
    ]
    return "\n".join(head + lines) if lines else ""


def speed_table(result: dict) -> str:
    """Decoders, the range over crops and errors, beside ours."""
    rows = result["speeds"]
    bench = ", ".join(f"{name} {rate:.1f}" for name, rate in result["bench"].items())
    lines = [
        "Decoding, Msamples/s of CPU time, the range over crops and errors; ours is `inspect --verify`, all"
    ]
    lines += [f"levels, reading and checksums included (`cargo bench`, by the clock: {bench}).", ""]
    lines += ["| | whole | 256² | 64² | ours / whole, at 5 m |", "|---|---|---|---|---|"]

    def rates(codec: str, layout: str, error: float | None = None) -> list[float]:
        return [
            row["decode_msamples_per_second"]
            for row in rows
            if (row["codec"], row["layout"]) == (codec, layout) and error in (None, row["error"])
        ]

    for codec in dict.fromkeys(row["codec"] for row in rows):
        cells = [rates(codec, layout) for layout in ("whole", "256", "64")]
        cells = [f"{min(cell):.0f}–{max(cell):.0f}" if cell else "" for cell in cells]
        ours, theirs = rates(OURS, "whole", 5.0), rates(codec, "whole", 5.0)
        ratio = f"{sum(ours) / sum(theirs):.2f}" if ours and theirs and len(ours) == len(theirs) else "–"
        lines.append(f"| {codec} | " + " | ".join(cells) + f" | {ratio} |")
    return "\n".join(lines)


def tin_table(rows: list[dict]) -> str:
    lines = [
        "Simplifiers, asked for 10 m:",
        "",
        "| DEM | which | triangles | true error | Msamples/s |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['dem']} | {row['simplifier']} | {row['triangles']} | {row['true_error']:.2f} m "
            f"| {row['msamples_per_second']:.2f} |"
        )
    return "\n".join(lines)


def versions(text: str) -> str:
    wanted = (
        "imagecodecs",
        "lerc",
        "charls",
        "libjxl",
        "sz3",
        "sperr",
        "zfp",
        "pcodec",
        "openjpeg",
        "openjph",
        "libwebp",
        "libpng-",
        "zstd",
    )
    return ", ".join(part.strip() for part in text.split(",") if part.strip().startswith(wanted))
