// Runs the benchmark's modules for wasm32, beside what the native program wrote:
// `node run.mjs NATIVE.json SECONDS NAME=MODULE.wasm...`. SECONDS 0: compares the checksums alone.
// Prints a table. Ends with 1 where a module's heights are not those of the native program, bit for bit.
import { readFileSync } from "node:fs";

const [native_file, seconds_text, ...modules] = process.argv.slice(2);
const native = JSON.parse(readFileSync(native_file, "utf8"));
const seconds = Number(seconds_text);

function measure(module, number) {
    module.choose(number);
    const rounds = [];
    const started = performance.now();
    while (rounds.length < 5 || performance.now() - started < seconds * 1e3) {
        module.lay_out(native.copies);
        const round = performance.now();
        module.decode();
        rounds.push(((performance.now() - round) * 1e3) / native.copies);
    }
    if (!module.is_right()) {
        throw new Error("what was decoded is not what was coded");
    }
    rounds.sort((a, b) => a - b);
    return rounds[rounds.length >> 1];
}

const columns = [{ name: "native", times: native.cases.map((c) => c.microseconds) }];
let same = true;
for (const argument of modules) {
    const [name, path] = argument.split("=");
    const { instance } = await WebAssembly.instantiate(readFileSync(path), {});
    const times = [];
    native.cases.forEach((known, number) => {
        const sums = BigInt.asUintN(64, instance.exports.sweep(number)).toString(16).padStart(16, "0");
        if (sums !== known.sums) {
            same = false;
            const what = sums.slice(0, 8) === known.sums.slice(0, 8) ? "heights" : "payloads";
            console.error(`${known.name}: ${name} has other ${what}: ${sums}, native ${known.sums}`);
        }
        times.push(seconds > 0 ? measure(instance.exports, number) : 0);
    });
    columns.push({ name, times });
}
if (seconds > 0) {
    console.log(`| points/decode, µs a diamond and Mpoints/s | ${columns.map((c) => c.name).join(" | ")} |`);
    console.log(`|${"---|".repeat(columns.length + 1)}`);
    native.cases.forEach((known, number) => {
        const cells = columns.map((c) => {
            const time = c.times[number];
            return `${time.toFixed(1)} µs, ${(known.points / time).toFixed(1)}`;
        });
        console.log(`| ${known.name} | ${cells.join(" | ")} |`);
    });
}
if (!same) {
    process.exit(1);
}
const count = modules.length;
console.log(`heights of ${native.cases.length} codings: ${count} modules find those of this machine, bit for bit`);
