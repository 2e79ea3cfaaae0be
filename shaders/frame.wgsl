// What all shaders of a frame share: uniforms, light and haze. Prepended to each of the others.
// The Rust twins of the structs are in client/src/render/frame.rs.
//
// Positions are relative to the eye, in metres: x east, y north, z up. Colours are linear.

struct Frame {
    clip_from_eye: mat4x4<f32>,
    // A view ray is forward + clip.x * right + clip.y * up.
    right: vec4<f32>,
    up: vec4<f32>,
    forward: vec4<f32>,
    // xyz: towards the sun. w: height of the eye, in metres.
    sun: vec4<f32>,
    // rgb: the sky at the horizon, which haze takes on. w: haze of a metre at height 0.
    horizon: vec4<f32>,
    // rgb: the sky overhead.
    zenith: vec4<f32>,
    // x: 1 to encode sRGB here, because the target does not. y: 1 to tint levels. z: 1 for one flat colour. w: 1 for a sky
    // that is as bright everywhere as at the horizon.
    options: vec4<f32>,
    // rgb: water that mirrors nothing. w: metres from the eye up to the mirror below which nothing is drawn.
    water: vec4<f32>,
    // Imagery: x: how much of the light on the ground it is shown in, 0 to 1. y: how much it hides of what is below it.
    // z: steps of its sampler. And w: radians that a pixel takes.
    drape: vec4<f32>,
    // rgb: colours of land, low to high. w: where each stands in the range of heights, 0 to 1.
    land: array<vec4<f32>, 8>,
    // rgb: colours of the sea, shallow to deep. w: where each stands in the range of depths, 0 to 1.
    sea: array<vec4<f32>, 4>,
    // x: how terrain is lit: 0 softly, 1 by the cosine alone, 2 not at all. y: 1 where slopes are coloured, and not heights.
    // z: 1 where rock shows on steep ground. w: how much the air glows around the sun.
    style: vec4<f32>,
}

struct Layer {
    // Metres of a lattice step.
    cell: vec2<f32>,
    // Metres from the eye to the reference point of the lattice, a point near the eye.
    offset: vec2<f32>,
    // Metres of a quantum, stretched.
    quantum: f32,
    // Metres from the eye up to the reference height, a height near the eye's.
    up_offset: f32,
    // Reference height, in quanta.
    height: i32,
    // 1 / depth of the deepest point, in metres; 0 where the layer has no sea.
    per_depth: f32,
    // The lowest height of land, in metres, and parts of the ramp for a metre above it.
    land_base: f32,
    per_height: f32,
    // What heights are multiplied by.
    exaggeration: f32,
    // 1 for a layer of water.
    is_water: f32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(1) @binding(0) var<uniform> layer: Layer;

// Metres over which haze thins out to 1/e, going up.
const HAZE_HEIGHT: f32 = 2500.0;

// The haze between the eye and a point `up` metres above it, `distance` metres away: 0 is none, 1 hides
// all. Its density falls with height as an exponential, so its integral along the straight line is known.
fn haze_to(up: f32, distance: f32) -> f32 {
    let eye = max(frame.sun.w, 0.0) / HAZE_HEIGHT;
    let point = max(frame.sun.w + up, 0.0) / HAZE_HEIGHT;
    let rise = point - eye;
    var density = exp(-eye);
    if abs(rise) > 1e-3 {
        density = (density - exp(-point)) / rise;
    }
    return 1.0 - exp(-frame.horizon.w * density * distance);
}

// A colour behind the haze between it and the eye.
fn hazed(colour: vec3<f32>, from_eye: vec3<f32>) -> vec3<f32> {
    return mix(colour, frame.horizon.rgb, haze_to(from_eye.z, length(from_eye)));
}

// The sky in a direction of length 1: a gradient by height above the horizon.
fn sky_towards(direction: vec3<f32>) -> vec3<f32> {
    if frame.options.w != 0.0 {
        return frame.horizon.rgb;
    }
    let above = mix(frame.horizon.rgb, frame.zenith.rgb, 1.0 - exp(-4.0 * max(direction.z, 0.0)));
    // Below the horizon there is haze, darker further down.
    return above * mix(1.0, 0.74, smoothstep(0.0, 0.7, -direction.z));
}

// Half of what the sun measures across, in radians: 0.53 degrees in all.
const SUN_RADIUS: f32 = 0.004625;

// What the sun adds to the sky in a direction of length 1: its disc, far brighter than white, and the glow of the air
// around it, as wide as dust and droplets scatter light ahead. `pixel`: radians of a pixel.
fn sun_towards(direction: vec3<f32>, pixel: f32) -> vec3<f32> {
    if frame.options.w != 0.0 {
        return vec3<f32>(0.0);
    }
    // The chord: the angle itself where that is small, and exact there, as the cosine is not.
    let off = length(direction - frame.sun.xyz);
    let soft = max(0.5 * pixel, 1e-5);
    let up = smoothstep(-soft, soft, direction.z);
    let disc = up * (1.0 - smoothstep(SUN_RADIUS - soft, SUN_RADIUS + soft, off));
    let glow = frame.style.w * smoothstep(-0.1, 0.05, direction.z) * (0.45 * exp(-off / 0.025) + 0.14 * exp(-off / 0.15));
    return vec3<f32>(1.08, 1.04, 0.97) * (40.0 * disc + glow);
}

// The light that a surface sends back: the sun, and the sky's half sphere, brighter from above. The sun
// fades out softly, as it does on rough ground: a sharp edge of light would follow the mesh.
fn lit(albedo: vec3<f32>, normal: vec3<f32>) -> vec3<f32> {
    let towards = dot(normal, frame.sun.xyz);
    let sun = vec3<f32>(1.08, 1.04, 0.97) * (0.5 * (towards + sqrt(towards * towards + 0.02)));
    let sky = vec3<f32>(0.25, 0.28, 0.34) * (0.5 + 0.5 * normal.z);
    return albedo * (sun + sky);
}

// What the mirrored picture tells in alpha of how far away the things are that it shows: from 0.5 near by to 1, in steps of a
// tenth; the sky has 0.
fn told_distance(metres: f32) -> f32 {
    return 0.5 + 0.5 * clamp((log2(metres) + 4.0) / 24.0, 0.0, 1.0);
}

// Linear light and sRGB, from 0 to 1.
fn to_srgb(c: vec3<f32>) -> vec3<f32> {
    let curve = 1.055 * pow(c, vec3<f32>(1.0 / 2.4)) - 0.055;
    return select(curve, 12.92 * c, c <= vec3<f32>(0.0031308));
}

fn from_srgb(c: vec3<f32>) -> vec3<f32> {
    let curve = pow((c + 0.055) / 1.055, vec3<f32>(2.4));
    return select(curve, c / 12.92, c <= vec3<f32>(0.04045));
}

// A finished colour, as the target wants it.
fn encoded(linear: vec3<f32>) -> vec4<f32> {
    let c = clamp(linear, vec3<f32>(0.0), vec3<f32>(1.0));
    return vec4<f32>(select(to_srgb(c), c, frame.options.x == 0.0), 1.0);
}
