"""A flight within a zone, for `diamantina-client fly --path`: from end to end of its largest part, looking around.

    python bench/zone_flight.py http://127.0.0.1:8080/scenes/NAME ZONE -o path.json [--seconds 20]
"""

import argparse
import json
import math
import urllib.request


def covers(rings, x, y):
    inside = False
    for ring in rings:
        for a, b in zip(ring, ring[1:] + ring[:1]):
            if (a[1] > y) != (b[1] > y) and x < a[0] + (y - a[1]) / (b[1] - a[1]) * (b[0] - a[0]):
                inside = not inside
    return inside


def width(points):
    xs, ys = zip(*points)
    return (max(xs) - min(xs)) * (max(ys) - min(ys))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene")
    parser.add_argument("zone")
    parser.add_argument("-o", "--output", required=True)
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    with urllib.request.urlopen(args.scene) as answer:
        zones = {zone["name"]: zone for zone in json.load(answer)["zones"]}
    zone = zones[args.zone]
    part = max(zone["parts"], key=lambda part: width(part["rings"][0]))
    xs, ys = zip(*part["rings"][0])
    # Across the longer side of its box: at each step the middle of the widest stretch within the polygon.
    tall = max(ys) - min(ys) > max(xs) - min(xs)
    along, across = (ys, xs) if tall else (xs, ys)
    middles = []
    for i in range(1, 12):
        at = min(along) + (max(along) - min(along)) * i / 12
        best, start = (0, 0), None
        steps = 400
        for j in range(steps + 1):
            side = min(across) + (max(across) - min(across)) * j / steps
            inside = j < steps and covers(part["rings"], *((side, at) if tall else (at, side)))
            if inside and start is None:
                start = side
            elif not inside and start is not None:
                best, start = max(best, (side - start, (side + start) / 2)), None
        if best[0] > 0:
            middles.append((best[1], at) if tall else (at, best[1]))
    # Four looks around at each place, then on to the next.
    keys = []
    z = part["ceiling"] - zone["eye"] / 2
    for i, (x, y) in enumerate(middles):
        for j in range(4):
            angle = (i * 0.7 + j / 4) * 2 * math.pi
            eye = [x, y, z]
            target = [x + 1000 * math.cos(angle), y + 1000 * math.sin(angle), z + 80]
            keys.append({"seconds": len(keys) * args.seconds / (4 * len(middles)), "eye": eye, "target": target})
    with open(args.output, "w", encoding="utf-8") as out:
        json.dump({"keys": keys}, out)
    print(f"{args.output}: {len(keys)} keys over {len(middles)} places")


if __name__ == "__main__":
    main()
