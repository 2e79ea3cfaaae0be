"""Scenes in an object store, against a real implementation of S3 (moto's server) and a real nginx: what is served is the
same as from a folder, and stays so when uploads are killed, publishers meet, the store goes away, blobs are damaged, and servers die.

Called by scripts/objects: objects.py SERVER [--away SECONDS]
"""

import argparse
import collections
import concurrent.futures
import contextlib
import http.client
import json
import logging
import os
import random
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import urllib.parse

import boto3
from moto.server import ThreadedMotoServer

BUCKET = "scenes"
ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


class Gate:
    """A TCP proxy that can be shut, silent, slow, or held from some point on."""

    def __init__(self, port):
        self.upstream = port
        self.mode = "open"
        self.pause = 0.0
        self.requests = 0
        self.seen = []
        self.pairs = []
        self.listener = socket.create_server(("127.0.0.1", 0), backlog=128)
        self.address = "http://127.0.0.1:%d" % self.listener.getsockname()[1]
        threading.Thread(target=self.accept, daemon=True).start()

    def accept(self):
        while True:
            client, _ = self.listener.accept()
            if self.mode == "shut":
                client.close()
                continue
            try:
                server = socket.create_connection(("127.0.0.1", self.upstream))
            except OSError:
                client.close()
                continue
            self.pairs.append((client, server))
            for source, to, is_request in ((client, server, True), (server, client, False)):
                threading.Thread(target=self.pump, args=(source, to, is_request), daemon=True).start()

    def pump(self, source, to, is_request):
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if is_request and data[:4] in (b"GET ", b"PUT ", b"HEAD", b"POST"):
                    self.requests += 1
                    self.seen.append(data.split(b" HTTP/")[0].decode())
                while self.mode == "silent":
                    time.sleep(0.02)
                if self.mode == "shut":
                    break
                time.sleep(self.pause)
                to.sendall(data)
        for end in (source, to):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def shut(self):
        self.mode = "shut"
        for pair in self.pairs:
            for end in pair:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
        self.pairs.clear()


class Server:
    """A running `serve`."""

    def __init__(self, program, env, *arguments):
        command = [program, "serve", *arguments, "--listen", "127.0.0.1:0"]
        self.log = tempfile.TemporaryFile("w+")
        self.process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=self.log, text=True)
        line = self.process.stdout.readline()
        if " at " not in line:
            self.log.seek(0)
            sys.exit(f"{command} does not serve: {line}{self.log.read()}")
        self.url = line.split(" at ")[1].strip()
        self.port = int(self.url.rsplit(":", 1)[1])

    def get(self, path, headers=None, timeout=30):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=timeout)
        try:
            connection.request("GET", path, headers=headers or {})
            answer = connection.getresponse()
            return answer.status, dict(answer.getheaders()), answer.read()
        finally:
            connection.close()

    def metric(self, name):
        lines = self.get("/metrics")[2].decode().splitlines()
        return float(next(line for line in lines if line.startswith(f"diamantina_{name}")).split()[-1])

    def text(self):
        self.log.seek(0)
        return self.log.read()

    def stop(self, kind=signal.SIGTERM):
        self.process.send_signal(kind)
        self.process.wait(30)


def blobs(store):
    """The address below the version, the pack, the offset and the length of each blob of a store in a folder."""
    with open(f"{store}/scene.json", encoding="utf-8") as file:
        scene = json.load(file)["scene"]
    with open(f"{store}/{scene['version']}/directory", "rb") as file:
        data = file.read()
    found = []
    for i in range(12, len(data), 32):
        layer, kind, _, a, b, pack, offset, length = struct.unpack_from("<BBHIIIII", data, i)
        name = scene["layers"][layer]["name"]
        path = {1: f"index/{a}", 2: f"points/{a}/{b}", 3: f"tin/{a}/{b}", 4: f"tin/index/{a}"}[kind]
        found.append((f"{name}/{path}", pack, offset, length))
    return scene, found


def check(is_so, words):
    if not is_so:
        raise AssertionError(words)


def same(ours, theirs, words):
    """The same answer, but for what differs by the moment."""
    kept = ("content-type", "cache-control", "etag", "content-length")
    heads = [{k.lower(): v for k, v in a[1].items() if k.lower() in kept} for a in (ours, theirs)]
    check(ours[0] == theirs[0] and heads[0] == heads[1] and ours[2] == theirs[2], f"{words}: {ours[:2]} {theirs[:2]}")


class Trial:
    def __init__(self, program, folder, away):
        self.program, self.folder, self.away = program, folder, away
        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self.moto = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
        self.moto.start()
        port = self.moto.get_host_and_port()[1]
        self.gate = Gate(port)
        self.env = dict(
            os.environ,
            AWS_ACCESS_KEY_ID="key-of-the-test",
            AWS_SECRET_ACCESS_KEY="secret-of-the-test",
            AWS_REGION="us-east-1",
            AWS_ALLOW_HTTP="true",
            AWS_ENDPOINT=f"http://127.0.0.1:{port}",
            RUST_LOG="info",
            SSL_CERT_FILE="/nonexistent",
        )
        self.gated = dict(self.env, AWS_ENDPOINT=self.gate.address)
        keys = {"aws_access_key_id": "k", "aws_secret_access_key": "s", "region_name": "us-east-1"}
        self.s3 = boto3.client("s3", endpoint_url=self.env["AWS_ENDPOINT"], **keys)
        self.s3.create_bucket(Bucket=BUCKET)
        self.servers = []

    def run(self, *arguments, expect=0, env=None):
        done = subprocess.run([self.program, *arguments], env=env or self.env, capture_output=True, text=True, timeout=120)
        check(done.returncode == expect, f"{arguments} ended with {done.returncode}, not {expect}: {done.stdout}{done.stderr}")
        check("secret-of-the-test" not in done.stdout + done.stderr, "a secret is told")
        return done.stdout + done.stderr

    def serve(self, *arguments, env=None):
        server = Server(self.program, env or self.env, *arguments)
        self.servers.append(server)
        return server

    def current(self, prefix):
        try:
            body = self.s3.get_object(Bucket=BUCKET, Key=f"{prefix}/scene.json")["Body"].read()
        except self.s3.exceptions.NoSuchKey:
            return None
        return json.loads(body)["scene"]["version"]

    def flip(self, key, byte, keep=True):
        """Flips a bit of an object, which keeps the hash that it was sent with, or does not."""
        found = self.s3.get_object(Bucket=BUCKET, Key=key)
        check("blake3" in found["Metadata"], f"{key} does not say its hash: {found['Metadata']}")
        body = bytearray(found["Body"].read())
        body[byte] ^= 4
        self.s3.put_object(Bucket=BUCKET, Key=key, Body=bytes(body), Metadata=found["Metadata"] if keep else {})

    def path(self, name):
        return os.path.join(self.folder, name)

    def make(self):
        """A small scene with triangles, in two versions, and one of noise, larger than a part of an upload."""
        with open(self.path("hills.asc"), "w", encoding="utf-8") as file:
            file.write("ncols 300\nnrows 260\nxllcorner 0\nyllcorner 0\ncellsize 30\n")
            for y in range(260):
                file.write(" ".join(str(500 + (x * y + x * x // 7) % 97 + x // 3) for x in range(300)) + "\n")
        with open(self.path("noise.raw"), "wb") as file:
            file.write(random.Random(1).randbytes(2 * 2049 * 2049))
        self.run("build", self.path("hills.asc"), "-o", self.path("hills"), "--encoding", "points,tin")
        self.run("build", self.path("hills.asc"), "-o", self.path("coarse"), "--scene", "hills", "--max-error", "9")
        self.run("build", self.path("noise.raw"), "--raw", "2049x2049:u16", "--cell", "30", "-o", self.path("noise"))

    def built_there(self):
        """`build -o s3://...` builds, sends and clears up, and is the same scene; `inspect` and `--verify` say so."""
        work = self.path("work")
        address = f"s3://{BUCKET}/a/hills"
        told = self.run("build", self.path("hills.asc"), "-o", address, "--encoding", "points,tin", "--work", work)
        check(f"serve {address}" in told, told)
        scene, _ = blobs(self.path("hills"))
        check(self.current("a/hills") == scene["version"], "the same build gives another version there")
        told = self.run("publish", work, address)
        check(" 0 bytes sent" in told, told)
        told = self.run("inspect", address, "--verify")
        check("verified: every blob" in told, told)
        told = self.run("build", self.path("hills.asc"), "-o", "s3://no-such-bucket/x", expect=1)
        check("no such bucket" in told, told)

    def same_bytes(self):
        """Every route answers as from the folder, with and without caches, and near blobs come together."""
        local = self.serve(self.path("hills"))
        scene, all_blobs = blobs(self.path("hills"))
        base = f"/scenes/hills/{scene['version']}"
        centres = [path.split("/")[2:] for path, *_ in all_blobs if "/points/" in path]
        batch = ";".join(f"{x},{y}" for x, y in centres[:60]) + ";3,3"
        paths = [f"{base}/{path}" for path, *_ in all_blobs]
        paths += [f"{base}/terrain/points?d={batch}", f"{base}/terrain/stream?error=0", f"{base}/terrain/stream?error=4&limit=20000"]
        paths += ["/scenes", "/scenes/hills", "/scenes/hills/terrain/height?x=3000&y=3000", "/scenes/hills/terrain/height?x=-1&y=0"]
        paths += [f"{base}/terrain/points/1/1", f"{base}/terrain/index/99", "/scenes/hills/0000000000000000/terrain/index/0"]
        address = f"s3://{BUCKET}/a/hills"
        caches = ([], ["--cache", "0"], ["--disk-cache", self.path("disk")], ["--cache", "0", "--disk-cache", self.path("disk")])
        asked = []
        for cache in caches:
            before = self.gate.requests
            remote = self.serve(address, *cache, env=self.gated)
            check(self.gate.requests - before == 2, f"opening takes {self.gate.requests - before} requests")
            with concurrent.futures.ThreadPoolExecutor(8) as pool:
                for path, ours, theirs in zip(paths, pool.map(local.get, paths), pool.map(remote.get, paths)):
                    same(ours, theirs, f"{cache} {path}")
            tag = remote.get(paths[0])[1]["etag"]
            check(remote.get(paths[0], {"If-None-Match": tag})[0] == 304, "a tag is not known again")
            asked.append(remote.metric("object_requests_total"))
            remote.stop()
        # The whole scene is one piece of a pack: it was asked for once, and after a restart not at all.
        check(asked[2] <= 8 and asked[3] == 0, f"with a disk cache {asked[2:]} requests")
        remote = self.serve(address, "--cache", "0", env=self.gated)
        remote.get(f"{base}/terrain/points?d={batch}")
        check(remote.metric("object_requests_total") <= 4, "a batch takes a request for each of its diamonds")
        remote.stop()
        local.stop()
        return f"{len(paths)} addresses, {asked} requests"

    def killed_uploads(self):
        """An upload that is killed leaves the scene before, and the next one sends the rest."""
        address = f"s3://{BUCKET}/k/scene"
        self.run("publish", self.path("hills"), address)
        before = self.current("k/scene")
        server = self.serve(address, "--reload", "1")
        dice, kills = random.Random(2), 0
        self.gate.pause = 0.01
        for _ in range(5):
            upload = subprocess.Popen([self.program, "publish", self.path("noise"), address], env=self.gated, stderr=subprocess.DEVNULL)
            try:
                upload.wait(0.1 + 0.7 * dice.random())
            except subprocess.TimeoutExpired:
                upload.kill()
                kills += 1
                upload.wait()
                check(self.current("k/scene") == before, "a killed upload has changed the scene")
                check(server.get("/scenes/hills")[0] == 200, "the scene before is not served")
        self.gate.pause = 0.0
        check(kills >= 3, f"only {kills} uploads were killed")
        server.stop()
        told = self.run("publish", self.path("noise"), address)
        check(self.current("k/scene") == blobs(self.path("noise"))[0]["version"], told)
        # A pack that is there already is not sent again.
        self.s3.delete_object(Bucket=BUCKET, Key=f"k/scene/{self.current('k/scene')}/directory")
        size = os.path.getsize(f"{self.path('noise')}/{self.current('k/scene')}/pack-00000")
        told = self.run("publish", self.path("noise"), address)
        check(f"{size} were there" in told, told)
        self.run("inspect", address)
        return f"{kills} kills"

    def two_publishers(self):
        """Of two who publish at once one is told that the other was faster, also where nothing was there before."""
        for prefix in ("p/new", "p/old"):
            address = f"s3://{BUCKET}/{prefix}"
            if prefix == "p/old":
                self.run("publish", self.path("noise"), address)
            self.gate.seen.clear()
            slow = subprocess.Popen(
                [self.program, "publish", self.path("hills"), address], env=self.gated, stderr=subprocess.PIPE, text=True
            )
            while not any(line.startswith("PUT") for line in self.gate.seen):
                time.sleep(0.005)
            self.gate.mode = "silent"
            self.run("publish", self.path("coarse"), address)
            self.gate.mode = "open"
            words = slow.communicate(timeout=60)[1]
            check(slow.returncode == 1 and "somebody else has published" in words, f"{slow.returncode}: {words}")
            check(self.current(prefix) == blobs(self.path("coarse"))[0]["version"], "the faster one's scene is gone")
            # Who looks again may replace it.
            self.run("publish", self.path("hills"), address, "--prune")
            self.run("publish", self.path("noise"), address, "--prune")
            listed = self.s3.list_objects_v2(Bucket=BUCKET, Prefix=f"{prefix}/", Delimiter="/")
            versions = {p["Prefix"].split("/")[-2] for p in listed["CommonPrefixes"]}
            expected = {blobs(self.path(name))[0]["version"] for name in ("hills", "noise")}
            check(versions == expected, f"{versions} are left, not {expected}")

    def gone_over(self):
        """A version that is published while another one is served takes over, and the one before stays for its readers."""
        address = f"s3://{BUCKET}/s/hills"
        self.run("publish", self.path("coarse"), address)
        server = self.serve(address, "--reload", "1")
        old, new = (blobs(self.path(name))[0]["version"] for name in ("coarse", "hills"))
        self.run("publish", self.path("hills"), address)
        due = time.monotonic() + 10
        while json.loads(server.get("/scenes/hills")[2])["version"] != new:
            check(time.monotonic() < due, "the new version is never served")
            time.sleep(0.1)
        for version in (old, new):
            check(server.get(f"/scenes/hills/{version}/terrain/index/0")[0] == 200, f"{version} is not served")
        server.stop()

    def store_away(self):
        """Without the store what is cached is served and the rest refused soon; with it all is as before."""
        scene, all_blobs = blobs(self.path("noise"))
        self.run("publish", self.path("noise"), f"s3://{BUCKET}/w/noise")
        server = self.serve(f"s3://{BUCKET}/w/noise", "--reload", "1", env=self.gated)
        paths = [f"/scenes/noise/{scene['version']}/{path}" for path, *_ in all_blobs if "/points/" in path]
        warm, cold = paths[:50], paths[50:100]
        known = {path: server.get(path)[2] for path in warm}
        worst = 0.0
        # One that is silent takes five seconds to be found out in any case.
        for mode, seconds in (("shut", self.away), ("silent", self.away / 5)):
            began = time.monotonic()
            self.gate.shut() if mode == "shut" else setattr(self.gate, "mode", mode)
            refused = 0
            while time.monotonic() < began + seconds:
                started = time.monotonic()
                with concurrent.futures.ThreadPoolExecutor(8) as pool:
                    answers = list(pool.map(server.get, cold[:8]))
                    hits = list(pool.map(server.get, warm))
                worst = max(worst, time.monotonic() - started)
                for status, headers, _ in answers:
                    check(status == 503 and int(headers["retry-after"]) > 0, f"{mode}: {status} {headers}")
                    refused += 1
                for path, (status, _, body) in zip(warm, hits):
                    check(status == 200 and body == known[path], f"{mode}: what is cached is answered with {status}")
                batch = f"/scenes/noise/{scene['version']}/terrain/points?d=" + ",".join(cold[9].split("/")[-2:])
                check(server.get(batch)[0] == 503, "a batch is not refused")
                height = server.get("/scenes/noise/terrain/height?x=40000&y=40000")
                check(height[0] == 503, f"a height is answered with {height[0]}")
            ready = server.get("/ready")
            check(ready[0] == 200 and b"cannot be reached" in ready[2], f"{ready}")
            check(server.metric("stores_away") == 1 and server.metric("store_away_total") >= refused, "it is not counted")
            self.gate.mode = "open"
            started = time.monotonic()
            while server.get(cold[0])[0] != 200:
                check(time.monotonic() < started + 5, "it does not recover")
                time.sleep(0.1)
            cold = cold[10:]
        check(server.get("/ready")[2] == b"ok\n" and server.metric("stores_away") == 0, "it does not say that it is well")
        check(server.metric("checksum_failures_total") == 0, "an outage is taken for damage")
        told = server.text()
        check("cannot be reached" in told and "can be reached again" in told, told)
        check("secret-of-the-test" not in told, "the log tells secrets")
        server.stop()
        return f"the slowest refusal after {worst:.1f} s"

    def damaged(self):
        """A flipped bit is never served, in the store or in the disk cache; `repair` mends it from any copy."""
        scene, all_blobs = blobs(self.path("hills"))
        key, address = f"d/hills/{scene['version']}/pack-00000", f"s3://{BUCKET}/d/hills"
        self.run("publish", self.path("hills"), address)
        disk = self.path("disk-d")
        path, _, offset, length = next(b for b in all_blobs if "/points/" in b[0])
        url = f"/scenes/hills/{scene['version']}/{path}"
        server = self.serve(address, "--cache", "0", "--disk-cache", disk)
        sound = server.get(url)
        check(sound[0] == 200, f"{sound[:2]}")
        pieces = [os.path.join(at, f) for at, _, files in os.walk(disk) for f in files if f != ".lock"]
        for piece in pieces:
            with open(piece, "r+b") as file:
                file.seek(offset + length // 2)
                byte = file.read(1)[0]
                file.seek(offset + length // 2)
                file.write(bytes([byte ^ 4]))
        check(pieces and server.get(url)[2] == sound[2], "a damaged disk cache is served")
        check(server.metric("object_rereads_total") == 1 and server.metric("checksum_failures_total") == 0, "no reread")
        # Bits that rot leave what the object says of itself as it was; others' tools may drop it.
        self.flip(key, offset + length // 2)
        server.stop()
        shutil.rmtree(disk)
        server = self.serve(address, "--disk-cache", disk)
        for _ in range(2):
            found = server.get(url)
            check(found[0] == 500 and b"damaged" in found[2], f"{found}")
        x, y = path.split("/")[2:]
        batch = None
        with contextlib.suppress(http.client.IncompleteRead):
            batch = server.get(f"/scenes/hills/{scene['version']}/terrain/points?d={x},{y}")
        check(batch is None, "a batch with something damaged ends well")
        check(server.metric("checksum_failures_total") >= 2, "it is not counted")
        told = server.text()
        check(f"a: {x}, b: {y}" in told and "pack-00000" in told, f"the log does not name it: {told}")
        told = self.run("inspect", address, "--verify", expect=1)
        check(f"a: {x}, b: {y}" in told, told)
        told = self.run("repair", address, expect=1)
        check("1 damaged" in told and "--from" in told, told)
        told = self.run("repair", address, "--from", self.path("hills"))
        check("1 mended, 0 damaged" in told, told)
        # The server needs no restart.
        check(server.get(url)[2] == sound[2], "what was mended is not served")
        server.stop()
        self.run("inspect", address, "--verify")
        self.flip(key, offset + length // 2, keep=False)
        told = self.run("repair", address, "--from", self.path("hills"))
        check("1 mended, 0 damaged" in told, told)
        self.run("inspect", address, "--verify")
        self.flip(f"d/hills/{scene['version']}/directory", 100)
        told = self.run("repair", address, "--from", self.path("hills"))
        check("the directory was replaced" in told, told)
        self.run("inspect", address, "--verify")
        # And a folder, from the object store and from a server.
        shutil.copytree(self.path("hills"), self.path("hurt"))
        pack = f"{self.path('hurt')}/{scene['version']}/pack-00000"
        with open(pack, "rb") as file:
            whole = file.read()
        good = self.serve(self.path("hills"))
        for source in (address, good.url, f"{good.url}/scenes/hills"):
            with open(pack, "r+b") as file:
                file.write(b"\0" * 5000)
            hurt = self.serve(self.path("hurt"))
            self.run("repair", self.path("hurt"), "--from", source)
            with open(pack, "rb") as file:
                check(file.read() == whole, f"not all is mended from {source}")
            check(hurt.get(url)[2] == sound[2], "a server that has it open does not see it")
            hurt.stop()
        good.stop()
        told = self.run("repair", self.path("hurt"), "--from", self.path("noise"), expect=1)
        check("expected a copy of version" in told, told)

    def nginx(self):
        """Two servers behind nginx as docker/nginx.conf has it: one is killed, and nobody sees more than a pause."""
        program = shutil.which("nginx", path=os.environ["PATH"] + ":/usr/sbin")
        if not program:
            print("SKIPPED: servers behind nginx, which is missing (apt-get install nginx-light)")
            return None
        scene, all_blobs = blobs(self.path("noise"))
        servers = [self.serve(f"s3://{BUCKET}/w/noise", "--cache", "1MiB") for _ in range(2)]
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        with open(f"{ROOT}/docker/nginx.conf", encoding="utf-8") as file:
            conf = file.read()
        for old, new in (
            ("server server-a:8080", f"server 127.0.0.1:{servers[0].port}"),
            ("server server-b:8080", f"server 127.0.0.1:{servers[1].port}"),
            ("listen 8080", f"listen 127.0.0.1:{port}"),
            ("/tmp/nginx", self.path("nginx")),
            ("/dev/stderr", self.path("nginx.log")),
        ):
            check(old in conf, f"docker/nginx.conf lacks '{old}'")
            conf = conf.replace(old, new)
        if os.geteuid() == 0:
            # Its workers would be somebody who may not enter our folder.
            conf = "user root;\n" + conf
        os.mkdir(self.path("nginx"))
        with open(self.path("nginx.conf"), "w", encoding="utf-8") as file:
            file.write(conf)
        proxy = subprocess.Popen([program, "-c", self.path("nginx.conf"), "-e", self.path("nginx.log"), "-g", "daemon off;"])
        try:
            front = object.__new__(Server)
            front.port = port
            for _ in range(100):
                with contextlib.suppress(OSError):
                    front.get("/health")
                    break
                time.sleep(0.05)
            local = self.serve(self.path("noise"))
            paths = [f"/scenes/noise/{scene['version']}/{path}" for path, *_ in all_blobs]
            random.Random(3).shuffle(paths)
            paths = paths[:600]
            centres = [p.split("/")[-2:] for p in paths if "/points/" in p]
            paths += [
                f"/scenes/noise/{scene['version']}/terrain/points?d=" + ";".join(f"{x},{y}" for x, y in centres[i : i + 20])
                for i in range(0, 400, 20)
            ]
            expected = {path: local.get(path) for path in paths}
            done = 0
            with concurrent.futures.ThreadPoolExecutor(8) as pool:
                for path, answer in zip(paths, pool.map(front.get, paths)):
                    same(expected[path], answer, f"through nginx {path}")
                    done += 1
                    if done == 150:
                        servers[0].stop(signal.SIGKILL)
            hits = [front.get(path) for path in paths[:100]]
            check(all(h[1].get("X-Cache-Status") == "HIT" for h in hits), "nginx does not cache what is immutable")
            names = {h[1].get("X-Request-Id") for h in hits}
            check(len(names) == len(hits) and None not in names, "kept answers have the names of other requests")
            front.get("/scenes/noise")
            described = front.get("/scenes/noise")[1]
            check(described.get("X-Cache-Status") is None, f"nginx keeps what changes: {described}")
            status = front.get("/scenes/noise", headers={"If-None-Match": described["etag"]})[0]
            check(status == 304, f"through nginx who has a description gets {status} instead of 304")
            self.long(front, scene)
            servers[1].stop(signal.SIGKILL)
            check(all(front.get(path)[2] == expected[path][2] for path in paths[:100]), "the cache is no use without servers")
            answer = front.get("/scenes/noise")
            check(answer[0] == 502 and answer[1].get("Retry-After") == "2", f"without servers nginx says {answer}")
            check(json.loads(answer[2])["status"] == 502, f"without servers nginx says {answer[2]}")
            local.stop()
            self.too_much(front, paths[0])
        finally:
            proxy.terminate()
            proxy.wait(10)
        return f"{len(paths)} requests, one of two servers killed"

    def long(self, front, scene):
        """Whatever the length of an address, a server answers it, or it is refused: no server counts as failed for it."""
        below = f"/scenes/noise/{scene['version']}/terrain/points?d="
        for length in [*range(2000, 9000, 37), *range(15_000, 18_000, 37)]:
            batch = (below + "0,0;" * (length // 4))[:length]
            status, headers, _ = front.get(batch)
            check(status in (200, 400, 413, 414), f"an address of {len(batch)} bytes: {status}")
            check(status != 200 or "X-Cache-Status" in headers, "a batch is not kept")

    def too_much(self, front, path):
        """Of one address nginx takes so many requests at once, and so many a second; soon it is asked as before."""
        with contextlib.ExitStack() as stack:
            for _ in range(256):
                held = stack.enter_context(socket.create_connection(("127.0.0.1", front.port)))
                # It waits for the rest of the body, which never comes.
                held.sendall(f"POST {path} HTTP/1.1\r\nHost: here\r\nContent-Length: 9\r\n\r\n".encode())
            self.until(lambda: front.get(path)[0] == 503, "an address may have as many connections as it likes")
            check(front.get(path)[1].get("Retry-After") == "1", "nginx does not say when to come back")
        self.until(lambda: front.get(path)[0] == 200, "closed connections are counted for ever")
        asked = f"HEAD {path} HTTP/1.1\r\nHost: here\r\n\r\n".encode() * 900
        statuses = []
        for _ in range(3):
            with socket.create_connection(("127.0.0.1", front.port), timeout=30) as stream:
                threading.Thread(target=stream.sendall, args=(asked,), daemon=True).start()
                with stream.makefile("rb") as lines:
                    heads = (line for line in lines if line.startswith(b"HTTP/1.1 "))
                    statuses += [int(line.split()[1]) for _, line in zip(range(900), heads)]
        check(set(statuses) == {200, 429}, f"2700 requests at once: {collections.Counter(statuses)}")
        self.until(lambda: front.get(path)[0] == 200, "who asked too much is refused for ever")

    def until(self, is_so, words):
        due = time.monotonic() + 10
        while not is_so():
            check(time.monotonic() < due, words)
            time.sleep(0.1)

    def end(self):
        for server in self.servers:
            if server.process.poll() is None:
                server.stop(signal.SIGKILL)
        self.moto.stop()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("server")
    parser.add_argument("--away", type=float, default=10.0, help="seconds for which the store cannot be reached")
    parser.add_argument("--only", help="one of the trials")
    arguments = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        trial = Trial(os.path.abspath(arguments.server), folder, arguments.away)
        try:
            trial.make()
            names = ["built_there", "same_bytes", "killed_uploads", "two_publishers", "gone_over", "store_away", "damaged", "nginx"]
            for name in names:
                if arguments.only and name not in arguments.only.split(","):
                    continue
                began = time.monotonic()
                try:
                    words = getattr(trial, name)()
                    print(f"{name}: ok, {time.monotonic() - began:.1f} s{', ' + words if words else ''}", flush=True)
                except Exception as error:  # The others are worth a try.
                    failed += 1
                    print(f"{name}: FAILED: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
                    for server in trial.servers:
                        if server.process.poll() is None:
                            print(server.text()[-1000:], file=sys.stderr)
                            server.stop(signal.SIGKILL)
                    trial.gate.mode, trial.gate.pause = "open", 0.0
        finally:
            trial.end()
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
