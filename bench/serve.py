"""How many requests a server answers, beside nginx with the same blobs as files: `scripts/bench-serve`.

One after the other, several rounds, in one run: each server alone with wrk, over loopback, with connections kept alive.
Of each server, the median round's requests a second, microseconds of its processor time a request, and 99th percentile of
latencies: as fast as it can, when the faster server also has the busier machine, and where each connection rests for 1 ms
after each answer, which is about the same load for all.

nginx is asked twice, since its workers take connections from one queue as they are awake: in some rounds one worker has
nearly all of them, and the other leaves its core to wrk. With `reuseport` the system deals them out. The busiest worker's
part of the processor time tells which it was.

Last, batches of blobs, and how many files of their size nginx sends: what the machine can move at all.
"""

import argparse
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import time
import urllib.request

# Of these bytes each, and as a store is built from a DEM.
SIZES = ["1kB", "8kB", "64kB", "built"]

LUA = """
local requests, next = {}, 0
function init(args)
    -- Not before: only now each request names its Host.
    for path in io.lines("PATHS") do requests[#requests + 1] = wrk.format("GET", path) end
end
function request()
    next = next % #requests + 1
    return requests[next]
end
"""

# After each answer, on each connection, in milliseconds.
RESTED = LUA + """
function delay()
    return 1
end
"""

NGINX = """
worker_processes 2;
pid FOLDER/nginx.pid;
error_log FOLDER/nginx.log;
daemon off;
events { worker_connections 4096; }
http {
    access_log off;
    sendfile on;
    tcp_nopush off;
    tcp_nodelay on;
    keepalive_timeout 60s;
    keepalive_requests 100000000;
    open_file_cache max=100000 inactive=60s;
    open_file_cache_valid 60s;
    default_type application/octet-stream;
    client_body_temp_path FOLDER/body;
    proxy_temp_path FOLDER/proxy;
    fastcgi_temp_path FOLDER/fastcgi;
    uwsgi_temp_path FOLDER/uwsgi;
    scgi_temp_path FOLDER/scgi;
    server {
        listen 127.0.0.1:PORT;
        listen 127.0.0.1:DEALT reuseport;
        root FOLDER/files;
        etag on;
        add_header Cache-Control "public, max-age=31536000, immutable";
        add_header Access-Control-Allow-Origin "*";
    }
}
"""


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait_for(port):
    for _ in range(200):
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.05)
    sys.exit(f"bench-serve: nothing listens on port {port}")


def workers(pid):
    """Where the processor times of what serves connections are told: a process's children, or its threads."""
    found = []
    for other in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = open(f"/proc/{other}/stat").read().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(f"/proc/{other}/stat")
    return found or [f"/proc/{pid}/task/{thread}/stat" for thread in os.listdir(f"/proc/{pid}/task")]


def cpu_seconds(stats):
    ticks = [sum(map(int, open(stat).read().rsplit(")", 1)[1].split()[11:13])) for stat in stats]
    return [t / os.sysconf("SC_CLK_TCK") for t in ticks]


def seconds(text):
    number, unit = re.fullmatch(r"([\d.]+)(us|ms|s|m)", text).groups()
    return float(number) * {"us": 1e-6, "ms": 1e-3, "s": 1.0, "m": 60.0}[unit]


def measure(port, stats, script, options):
    """One round: requests a second, processor seconds a request, the 99th percentile, the busiest worker's part."""
    command = ["wrk", "-t1", f"-c{options.connections}", f"-d{options.seconds}s", "--latency", "-s", script]
    before, started = cpu_seconds(stats), time.monotonic()
    out = subprocess.run(command + [f"http://127.0.0.1:{port}"], capture_output=True, text=True, check=True).stdout
    used = [after - first for first, after in zip(before, cpu_seconds(stats))]
    took = time.monotonic() - started
    count = int(re.search(r"(\d+) requests in", out).group(1))
    if "Non-2xx" in out or "Socket errors" in out:
        sys.exit(f"bench-serve: answers failed:\n{out}")
    p99 = seconds(re.search(r"^\s+99%\s+(\S+)", out, re.MULTILINE).group(1))
    return count / took, sum(used) / count, p99, max(used) / sum(used)


def medians(rounds):
    return [statistics.median(values) for values in zip(*rounds)]


def bytes_of(port, path):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}") as answer:
        return len(answer.read())


def script_of(text, folder, name, paths):
    script = f"{folder}/{name}.lua"
    with open(script, "w") as f:
        f.write(text.replace("PATHS", f"{folder}/{paths}.paths"))
    return script


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", help="what the example `blobs` has made")
    parser.add_argument("server", help="the program diamantina-server")
    parser.add_argument("--seconds", type=int, default=2, help="of a round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--connections", type=int, default=32)
    options = parser.parse_args()
    folder = os.path.abspath(options.folder)
    ports = {name: free_port() for name in ("nginx", "nginx, reuseport", "diamantina")}
    with open(f"{folder}/nginx.conf", "w") as f:
        config = NGINX.replace("FOLDER", folder).replace("PORT", str(ports["nginx"]))
        f.write(config.replace("DEALT", str(ports["nginx, reuseport"])))
    stores = [f"{folder}/stores/{size}" for size in SIZES]
    quiet = {"stdout": subprocess.DEVNULL}
    address = f"127.0.0.1:{ports['diamantina']}"
    nginx = subprocess.Popen(["nginx", "-c", f"{folder}/nginx.conf"], **quiet)
    diamantina = subprocess.Popen([options.server, "serve", *stores, "--listen", address], **quiet)
    try:
        for port in ports.values():
            wait_for(port)
        of = {name: workers((diamantina if name == "diamantina" else nginx).pid) for name in ports}
        print("| blobs | server | requests/s | CPU a request | p99 | p99 at equal load | busiest worker |")
        print("|---|---|---|---|---|---|---|")
        rates, lines = {}, []
        for size in SIZES:
            scripts = [script_of(LUA, folder, size, size), script_of(RESTED, folder, f"{size}.rested", size)]
            rounds = {name: ([], []) for name in ports}
            for _ in range(options.rounds):
                for name, port in ports.items():
                    for script, found in zip(scripts, rounds[name]):
                        found.append(measure(port, of[name], script, options))
            found = {}
            for name, (fast, rested) in rounds.items():
                (rate, cpu, p99, _), rested_p99 = medians(fast), medians(rested)[2]
                found[name] = (rate, cpu, p99, rested_p99)
                parts = sorted(part for *_, part in fast)
                print(
                    f"| {size} | {name} | {rate:.0f} | {cpu * 1e6:.1f} us | {p99 * 1e3:.2f} ms | {rested_p99 * 1e3:.2f} ms"
                    f" | {parts[0]:.2f} to {parts[-1]:.2f} |",
                    flush=True,
                )
            rates[size] = found["diamantina"][0]
            for other in ("nginx", "nginx, reuseport"):
                ratios = [f"{a / b:.2f}" for a, b in zip(found["diamantina"], found[other])]
                lines.append(f"| {size} | {other} | {' | '.join(ratios)} |")
        print("\n| blobs | diamantina to | requests/s | CPU a request | p99 | p99 at equal load |\n|---|---|---|---|---|---|")
        print("\n".join(lines))
        print(
            "\n| blobs | diamonds a batch | batches/s | diamonds/s | of single requests' | files of a batch's size, nginx |"
            "\n|---|---|---|---|---|---|"
        )
        for size in SIZES:
            lines = [line.split(" ", 1) for line in open(f"{folder}/{size}.batches").read().splitlines()]
            routes, name = [route for _, route in lines], f"{size}.batch"
            length = sum(bytes_of(ports["diamantina"], route) for route in routes) // len(routes)
            with open(f"{folder}/files/{name}", "wb") as f:
                f.write(os.urandom(length))
            rounds = {"diamantina": [], "nginx, reuseport": []}
            for server, paths in (("diamantina", routes), ("nginx, reuseport", [f"/{name}"])):
                with open(f"{folder}/{name}.paths", "w") as f:
                    f.writelines(path + "\n" for path in paths)
                script = script_of(LUA, folder, name, name)
                for _ in range(options.rounds):
                    rounds[server].append(measure(ports[server], of[server], script, options))
            rate, files = (medians(rounds[server])[0] for server in rounds)
            mean = sum(int(count) for count, _ in lines) / len(lines)
            print(
                f"| {size} | {mean:.0f} | {rate:.0f} | {rate * mean:.0f} | {rate * mean / rates[size]:.1f} | {files:.0f}/s |",
                flush=True,
            )
    finally:
        for server in (nginx, diamantina):
            server.send_signal(signal.SIGTERM)
            server.wait(30)


main()
