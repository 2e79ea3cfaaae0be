"""How a server bears many users, and connections that do nothing: `scripts/bench-users`.

Server and users run beside each other on one machine, over loopback. First users alone, for long: errors, latencies, and
every few seconds the server's memory and open files. Then fewer users, twice: without and with connections beside
them of which half say nothing and half send their request a byte at a time.
"""

import argparse
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import time


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Server:
    def __init__(self, program, store):
        self.port = free_port()
        many = "20000"
        self.process = subprocess.Popen(
            [program, "serve", store, "--listen", f"127.0.0.1:{self.port}", "--rate", "0",
             "--max-connections", many, "--max-connections-per-address", many, "--max-in-flight", many],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(100):
            try:
                socket.create_connection(("127.0.0.1", self.port), 1).close()
                return
            except OSError:
                time.sleep(0.1)
        raise SystemExit("the server does not answer")

    def seen(self):
        """Resident bytes, open files, and seconds of processor time."""
        folder = f"/proc/{self.process.pid}"
        with open(f"{folder}/status") as status:
            resident = next(int(line.split()[1]) << 10 for line in status if line.startswith("VmRSS"))
        with open(f"{folder}/stat") as stat:
            fields = stat.read().rsplit(")", 1)[1].split()
        ticks = os.sysconf("SC_CLK_TCK")
        return resident, len(os.listdir(f"{folder}/fd")), (int(fields[11]) + int(fields[12])) / ticks

    def stop(self):
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(40)


class Idle:
    """Connections of which every second one sends a byte of a request every few seconds, and starts anew when closed."""

    REQUEST = b"GET /health HTTP/1.1\r\nHost: here\r\n"

    def __init__(self, port, count):
        self.port, self.opened, self.open = port, 0, []
        self.selector = selectors.DefaultSelector()
        for number in range(count):
            self.start(number)

    def start(self, number):
        one = socket.create_connection(("127.0.0.1", self.port), 5)
        one.setblocking(False)
        self.selector.register(one, selectors.EVENT_READ, [number, 0])
        self.opened += 1

    def turn(self):
        """Starts those anew that were closed, and lets a byte of each second one go."""
        for key, _ in self.selector.select(0):
            try:
                ended = not key.fileobj.recv(4096)
            except BlockingIOError:
                ended = False
            except OSError:
                ended = True
            if ended:
                self.selector.unregister(key.fileobj)
                key.fileobj.close()
                self.start(key.data[0])
        for key in list(self.selector.get_map().values()):
            number, sent = key.data
            if number % 2 and sent < len(self.REQUEST):
                try:
                    key.fileobj.send(self.REQUEST[sent:sent + 1])
                    key.data[1] += 1
                except OSError:
                    pass

    def stop(self):
        for key in list(self.selector.get_map().values()):
            key.fileobj.close()


def load(options, server, users, seconds, beside=None):
    command = [options.client, "load", f"http://127.0.0.1:{server.port}/", "--users", str(users),
               "--seconds", str(seconds), "--arrival", str(seconds / 10), "--think", str(options.think),
               "--error-pixels", str(options.error_pixels), "--json", "-"]
    rows, before = [], server.seen()[2]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        began = last = time.monotonic()
        while client.poll() is None:
            time.sleep(0.2)
            if time.monotonic() - last >= seconds / 10:
                last = time.monotonic()
                rows.append((last - began, *server.seen()[:2]))
                if beside:
                    beside.turn()
        out, err = client.communicate()
    if client.returncode not in (0, 1) or not out:
        raise SystemExit(f"load: {client.returncode}: {err}")
    report = json.loads(out)
    report["cpu"] = (server.seen()[2] - before) / seconds
    return report, rows


def told(name, report):
    diamonds, requests = report["diamonds"], report["requests"]
    print(f"| {name} | {report['requests_a_second']:.0f} | {report['diamonds_a_second']:.0f} "
          f"| {diamonds['p50']:.1f} / {diamonds['p99']:.1f} / {diamonds['max']:.0f} "
          f"| {requests['p99']:.1f} | {sum(report['errors'].values())} | {report['cpu']:.2f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("server")
    parser.add_argument("client")
    parser.add_argument("--users", type=int, default=1000)
    parser.add_argument("--seconds", type=int, default=300)
    parser.add_argument("--think", type=float, default=5.0)
    parser.add_argument("--error-pixels", type=float, default=2.0)
    parser.add_argument("--idle", type=int, default=2000)
    options = parser.parse_args()
    print("| users | requests/s | diamonds/s | a diamond, ms: p50 / p99 / most | a request, ms: p99 | errors | cores |")
    print("|---|---|---|---|---|---|---|")
    server = Server(options.server, options.store)
    try:
        report, rows = load(options, server, options.users, options.seconds)
        told(f"{options.users}, {options.seconds} s", report)
        errors = sum(report["errors"].values())
    finally:
        server.stop()
    server = Server(options.server, options.store)
    try:
        few, short = max(options.users // 5, 1), max(options.seconds // 5, 10)
        report, _ = load(options, server, few, short)
        told(f"{few}, {short} s", report)
        errors += sum(report["errors"].values())
        idle = Idle(server.port, options.idle)
        try:
            report, with_idle = load(options, server, few, short, idle)
        finally:
            idle.stop()
        told(f"the same beside {options.idle} idle", report)
        errors += sum(report["errors"].values())
        print(f"\n{idle.opened} idle connections were opened in all; "
              f"{max(files for _, _, files in with_idle)} open files at most.\n")
    finally:
        server.stop()
    print("| seconds | resident, MB | open files |\n|---|---|---|")
    for seconds, resident, files in rows:
        print(f"| {seconds:.0f} | {resident / 1e6:.0f} | {files} |")
    sys.exit(1 if errors else 0)


if __name__ == "__main__":
    main()
