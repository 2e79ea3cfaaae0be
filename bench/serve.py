"""How many requests a server answers, beside nginx with the same blobs as files: `scripts/bench-serve`.

One after the other, several rounds, in one run: each server alone with wrk, over loopback, with connections kept alive.
Of each server: requests a second, microseconds of its processor time a request, the 99th percentile of latencies. The
best round counts, since others share the machine.
"""

import argparse
import os
import re
import signal
import socket
import subprocess
import sys
import time

SIZES = ["1kB", "8kB", "64kB"]

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


def family(pid):
    """A process and its children."""
    pids = [pid]
    for other in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = open(f"/proc/{other}/stat").read().rsplit(")", 1)[1].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            pids.append(int(other))
    return pids


def cpu_seconds(pids):
    ticks = 0
    for pid in pids:
        fields = open(f"/proc/{pid}/stat").read().rsplit(")", 1)[1].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def seconds(text):
    number, unit = re.fullmatch(r"([\d.]+)(us|ms|s|m)", text).groups()
    return float(number) * {"us": 1e-6, "ms": 1e-3, "s": 1.0, "m": 60.0}[unit]


def measure(port, pids, script, options):
    """One round: requests a second, processor seconds a request, the 99th percentile, bytes a second."""
    command = ["wrk", "-t1", f"-c{options.connections}", f"-d{options.seconds}s", "--latency", "-s", script]
    before, started = cpu_seconds(pids), time.monotonic()
    out = subprocess.run(command + [f"http://127.0.0.1:{port}"], capture_output=True, text=True, check=True).stdout
    used, took = cpu_seconds(pids) - before, time.monotonic() - started
    count = int(re.search(r"(\d+) requests in", out).group(1))
    if "Non-2xx" in out or "Socket errors" in out:
        sys.exit(f"bench-serve: answers failed:\n{out}")
    p99 = seconds(re.search(r"^\s+99%\s+(\S+)", out, re.MULTILINE).group(1))
    return count / took, used / count, p99


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", help="what the example `blobs` has made")
    parser.add_argument("server", help="the program diamantina-server")
    parser.add_argument("--seconds", type=int, default=4, help="of a round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--connections", type=int, default=32)
    options = parser.parse_args()
    folder = os.path.abspath(options.folder)
    ports = {"nginx": free_port(), "diamantina": free_port()}
    with open(f"{folder}/nginx.conf", "w") as f:
        f.write(NGINX.replace("FOLDER", folder).replace("PORT", str(ports["nginx"])))
    stores = [f"{folder}/stores/{size}" for size in SIZES]
    quiet = {"stdout": subprocess.DEVNULL}
    address = f"127.0.0.1:{ports['diamantina']}"
    servers = {
        "nginx": subprocess.Popen(["nginx", "-c", f"{folder}/nginx.conf"], **quiet),
        "diamantina": subprocess.Popen([options.server, "serve", *stores, "--listen", address], **quiet),
    }
    try:
        for port in ports.values():
            wait_for(port)
        pids = {name: family(server.pid) for name, server in servers.items()}
        print("| blobs | server | requests/s | CPU a request | p99 | of nginx's: requests/s, CPU, p99 |")
        print("|---|---|---|---|---|---|")
        rates = {}
        for size in SIZES:
            script = f"{folder}/{size}.lua"
            with open(script, "w") as f:
                f.write(LUA.replace("PATHS", f"{folder}/{size}.paths"))
            rounds = {name: [] for name in servers}
            for _ in range(options.rounds):
                for name in servers:
                    rounds[name].append(measure(ports[name], pids[name], script, options))
            best = {n: (max(r[0] for r in rs), min(r[1] for r in rs), min(r[2] for r in rs)) for n, rs in rounds.items()}
            rates[size] = best["diamantina"][0]
            for name, (rate, cpu, p99) in best.items():
                to_nginx = ", ".join(f"{a / b:.2f}" for a, b in zip(best[name], best["nginx"]))
                print(f"| {size} | {name} | {rate:.0f} | {cpu * 1e6:.1f} us | {p99 * 1e3:.2f} ms | {to_nginx} |")
        print("\n| blobs | diamonds a batch | batches/s | diamonds/s | of single requests' |\n|---|---|---|---|---|")
        for size in SIZES:
            lines = [line.split(" ", 1) for line in open(f"{folder}/{size}.batches").read().splitlines()]
            with open(f"{folder}/{size}.batch.paths", "w") as f:
                f.writelines(route + "\n" for _, route in lines)
            script = f"{folder}/{size}.batch.lua"
            with open(script, "w") as f:
                f.write(LUA.replace("PATHS", f"{folder}/{size}.batch.paths"))
            mean = sum(int(count) for count, _ in lines) / len(lines)
            found = [measure(ports["diamantina"], pids["diamantina"], script, options) for _ in range(options.rounds)]
            rate = max(r[0] for r in found)
            print(f"| {size} | {mean:.0f} | {rate:.0f} | {rate * mean:.0f} | {rate * mean / rates[size]:.1f} |")
    finally:
        for server in servers.values():
            server.send_signal(signal.SIGTERM)
            server.wait(30)


main()
