"""A flight at random over a scene, and what it takes: memory, GPU memory, bytes, seconds to the first picture.

The same flight is flown several times: with little memory and an empty disk cache, with the same cache once more (the
next session), and with the client's own budgets. Each frame's figures come from the client's CSV, the process's memory
(VmRSS) from the system, four times a second. A software adapter keeps what a graphics card would have in the same
memory, so VmRSS holds both budgets and the driver itself.

    flight.py STORE SERVER CLIENT [--seconds 600] [--frames 6000] [--fps 10]
"""

import argparse
import csv
import json
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import time

MIB = 1 << 20


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("store", type=pathlib.Path)
    parser.add_argument("server")
    parser.add_argument("client")
    parser.add_argument("--seconds", type=float, default=600.0, help="of the flight (600)")
    parser.add_argument("--frames", type=int, default=6000, help="of the flight (6000)")
    parser.add_argument("--fps", type=float, default=10.0, help="frames a second at most (10); 0: as fast as they can be drawn")
    parser.add_argument("--size", default="640x360", help="of the picture (640x360)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--memory", default="256MiB", help="the small budget (256MiB)")
    parser.add_argument("--gpu-memory", default="128MiB", help="the small budget (128MiB)")
    parser.add_argument("--only", help="one of the flights alone: little, again, usual")
    parser.add_argument("--csv", type=pathlib.Path, help="keep the frames' figures in this folder")
    return parser.parse_args()


def serve(server, store):
    """A server of a store on a free port: the process, and its address."""
    process = subprocess.Popen(
        [server, "serve", str(store), "--listen", "127.0.0.1:0"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    for line in process.stdout:
        found = re.search(r"http://127\.0\.0\.1:\d+", line)
        if found:
            return process, found.group()
    sys.exit("flight: the server does not start")


def resident(pid):
    """Bytes of memory of a process now; 0 once it has ended."""
    try:
        text = pathlib.Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    found = re.search(r"VmRSS:\s+(\d+) kB", text)
    return int(found.group(1)) * 1024 if found else 0


def fly(args, url, name, folder, options):
    """Flies once, and tells the most of each figure."""
    table = folder / f"{name}.csv"
    command = [args.client, "fly", url, "--random", str(args.seed), "--seconds", str(args.seconds)]
    command += ["--frames", str(args.frames), "--fps", str(args.fps), "--size", args.size, "--csv", str(table), *options]
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    samples = []
    while process.poll() is None:
        samples.append((time.monotonic() - began, resident(process.pid)))
        time.sleep(0.25)
    if process.returncode != 0:
        sys.exit(f"flight: {' '.join(command)} ended with {process.returncode}")
    with open(table, newline="") as file:
        frames = list(csv.DictReader(file))
    numbers = lambda column: [float(frame[column]) for frame in frames]
    first = next((f for f in frames if f["error_pixels"] != "inf"), frames[-1])
    errors = sorted(numbers("error_pixels"))
    fifth = max(1, len(samples) // 5)
    return {
        "flight": name,
        "options": " ".join(o for o in options if not o.startswith(str(folder))),
        "seconds": samples[-1][0],
        "resident_most": max(numbers("resident_bytes")),
        "gpu_most": max(numbers("gpu_bytes")),
        "gpu_fixed": max(numbers("gpu_fixed_bytes")),
        "rss_most": max(bytes for _, bytes in samples),
        "rss_of_fifths": [max((b for _, b in samples[i * fifth : (i + 1) * fifth]), default=0) for i in range(5)],
        "network_bytes": float(frames[-1]["bytes"]),
        "requests": float(frames[-1]["requests"]),
        "disk_bytes": float(frames[-1]["disk_bytes"]),
        "first_picture": float(first["seconds"]),
        "error_middle": errors[len(errors) // 2],
        "limited": sum(f["limited_by_memory"] == "true" for f in frames) / len(frames),
        "complete": sum(f["complete"] == "true" for f in frames) / len(frames),
    }


def main():
    args = arguments()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.csv or pathlib.Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        kept = pathlib.Path(scratch) / "kept"
        server, base = serve(args.server, args.store)
        try:
            little = ["--memory", args.memory, "--gpu-memory", args.gpu_memory, "--disk-cache", str(kept)]
            flights = {"little": little, "again": little, "usual": []}
            results = []
            for name, options in flights.items():
                if args.only in (None, name):
                    results.append(fly(args, base, name, folder, options))
                    print(json.dumps(results[-1]), file=sys.stderr, flush=True)
            disk = sum(file.stat().st_size for file in kept.iterdir()) if kept.exists() else 0
        finally:
            server.terminate()
            server.wait()
        shutil.rmtree(kept, ignore_errors=True)
    print("| flight | diamonds, MiB at most | GPU, MiB at most | besides | VmRSS, MiB at most | of each fifth | received | requests | from disk | first picture | middle error | short of memory |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for r in results:
        mib = lambda bytes: f"{bytes / MIB:.0f}"
        print(
            f"| {r['flight']}, {r['seconds']:.0f} s | {mib(r['resident_most'])} | {mib(r['gpu_most'])} | {mib(r['gpu_fixed'])} "
            f"| {mib(r['rss_most'])} | {', '.join(mib(b) for b in r['rss_of_fifths'])} | {r['network_bytes'] / 1e6:.2f} MB "
            f"| {r['requests']:.0f} | {r['disk_bytes'] / 1e6:.2f} MB | {r['first_picture']:.2f} s | {r['error_middle']:.2f} px "
            f"| {100 * r['limited']:.0f} % of frames |"
        )
    print(f"\ndisk cache: {disk / 1e6:.1f} MB")


main()
