// Water: what is mirrored in it and what is seen through it, mixed as Fresnel found (in Schlick's form); light that it
// takes away on its way through (Beer and Lambert), and small waves that bend both pictures.
//
// Both pictures are textures as large as the screen, projected: the mirrored one is what the eye, mirrored in the mean
// plane of the surface, sees of the scene without water; the other what the eye sees of it. Over a level surface without
// waves each pixel takes the mirrored picture's own pixel, exactly.

struct Water {
    // rgb: what a metre of water takes away of light, as the exponent. w: metres of depth over which the shore fades in.
    absorption: vec4<f32>,
    // rgb: what deep water sends back of white light. w: metres around where ground ends in which a coast is drawn smooth.
    body: vec4<f32>,
    // x: the part that is mirrored looking straight down. y: 1 / refractive index. z: metres of the near plane.
    // w: how bright the sun glitters.
    optics: vec4<f32>,
    // Each wave: xy the wave vector, in radians a metre; z the phase at the eye; w how high it is, in metres above the mean.
    waves: array<vec4<f32>, 24>,
}

// The variance of slopes, along an axis, of ripples smaller than the waves: near, and where waves are smaller than a pixel.
const RIPPLES: vec2<f32> = vec2<f32>(4e-4, 3e-3);

// What the sun sends onto the water, of what makes the sky's white: less than it does, since here what is too bright is lost.
const SUNLIGHT: f32 = 0.18;

@group(2) @binding(0) var<uniform> water: Water;
@group(2) @binding(1) var smooth_sampler: sampler;
@group(2) @binding(2) var mirrored: texture_2d<f32>;
@group(2) @binding(3) var scene: texture_2d<f32>;
// The depth of `scene`, reversed: the near plane's distance over the distance forward. Read through a sampler: without one
// WebGL2 takes its default, which a texture of depths must not be mixed by, and reads 0.
@group(2) @binding(4) var scene_depth: texture_2d<f32>;
@group(2) @binding(5) var exact_sampler: sampler;

// Where on the screen a direction or a place, relative to the eye, is seen: x and y from 0 to 1 down and to the right,
// and whether it is ahead at all.
fn projected(p: vec3<f32>) -> vec3<f32> {
    let clip = frame.clip_from_eye * vec4<f32>(p, 1.0);
    let place = vec2<f32>(0.5, -0.5) * clip.xy / max(clip.w, 1e-12) + 0.5;
    return vec3<f32>(place, select(0.0, 1.0, clip.w > 0.0));
}

// The slope of the waves at a place; those too small for a pixel, which goes from the place to `right` and `down` of it,
// are left out: z is the variance of their slopes along an axis, ripples included.
fn wave_slope(across: vec2<f32>, right: vec2<f32>, down: vec2<f32>) -> vec3<f32> {
    var slope = vec3<f32>(0.0);
    var shortest = 0.0;
    // Whichever way a wave goes, a pixel covers at least so many metres of it.
    let least = abs(right.x * down.y - right.y * down.x) / max(length(right) + length(down), 1e-20);
    for (var i = 0; i < 24; i++) {
        let wave = water.waves[i];
        let steepness = wave.w * wave.w * dot(wave.xy, wave.xy);
        if dot(wave.xy, wave.xy) * least * least >= 1.44 {
            // Those that follow are shorter, and as steep.
            slope.z += f32(24 - i) * 0.25 * steepness;
            shortest = 1.0;
            break;
        }
        // Radians of the wave that a pixel covers: beyond pi its samples show another wave.
        let step = max(abs(dot(wave.xy, right)), abs(dot(wave.xy, down)));
        let seen = 1.0 - smoothstep(0.3, 1.2, step);
        if seen > 0.0 {
            slope += vec3<f32>(wave.xy * (wave.w * seen * cos(dot(wave.xy, across) + wave.z)), 0.0);
        }
        slope.z += 0.25 * steepness * (1.0 - seen * seen);
        shortest = max(shortest, 1.0 - seen);
    }
    return slope + vec3<f32>(0.0, 0.0, mix(RIPPLES.x, RIPPLES.y, shortest));
}

// How bright facets of the surface send the sun to the eye, whose slopes vary about that of `normal` by `variance` along
// each axis: after Cox and Munk, Measurement of the Roughness of the Sea Surface from Photographs of the Sun's Glitter (1954).
fn glitter_of(ray: vec3<f32>, normal: vec3<f32>, variance: f32) -> f32 {
    let facet = normalize(frame.sun.xyz - ray);
    if facet.z <= 0.0 || frame.sun.z <= 0.0 {
        return 0.0;
    }
    let off = facet.xy / facet.z - normal.xy / max(normal.z, 0.1);
    let share = exp(-0.5 * dot(off, off) / variance) / (6.2832 * variance);
    let steep = facet.z * facet.z;
    return share / (4.0 * steep * steep * max(-dot(ray, normal), 0.1));
}

fn exact_depth(place: vec2<f32>) -> f32 {
    return textureSampleLevel(scene_depth, exact_sampler, place, 0.0).x;
}

// The middle of the pixel up and to the left of a place of the screen, of the four around it.
fn corner_of(place: vec2<f32>, size: vec2<f32>) -> vec2<f32> {
    return floor(place * size - 0.5) + 0.5;
}

// The depths of the four pixels around a place of the screen: the upper two, then the lower two.
fn depths_around(place: vec2<f32>, size: vec2<f32>) -> vec4<f32> {
    let low = corner_of(place, size) / size;
    let high = low + 1.0 / size;
    return vec4<f32>(
        exact_depth(low), exact_depth(vec2<f32>(high.x, low.y)), exact_depth(vec2<f32>(low.x, high.y)), exact_depth(high),
    );
}

fn least_of(v: vec4<f32>) -> f32 {
    return min(min(v.x, v.y), min(v.z, v.w));
}

fn most_of(v: vec4<f32>) -> f32 {
    return max(max(v.x, v.y), max(v.z, v.w));
}

// The depth of the scene without water at a place of the screen, between the four pixels around it: the nearest pixel's
// would jump, and its jumps show as contours of the bed. One over the distance is straight along a plane, so that it may be
// mixed as it is; not across an outline, where nothing lies between what is near and what is far.
fn depth_at(place: vec2<f32>) -> f32 {
    let size = vec2<f32>(textureDimensions(scene));
    let around = depths_around(place, size);
    if most_of(around) > 1.25 * least_of(around) {
        return exact_depth(place);
    }
    let part = place * size - corner_of(place, size);
    return mix(mix(around.x, around.y, part.x), mix(around.z, around.w, part.x), part.y);
}

// Metres from the eye to what the scene without water shows at a place of the screen, along a ray that goes `forward`
// metres ahead a metre; a great many where that is the sky.
fn scene_distance(place: vec2<f32>, forward: f32) -> f32 {
    return water.optics.z / max(depth_at(place), 1e-20) / forward;
}

fn ray_through(place: vec2<f32>) -> vec3<f32> {
    let clip = vec2<f32>(2.0, -2.0) * (place - 0.5);
    return normalize(frame.forward.xyz + clip.x * frame.right.xyz + clip.y * frame.up.xyz);
}

// Metres ahead of the eye, and up from it, of what the scene without water shows at a place of the screen, or at its edge: both
// a great many where that is the sky.
fn scene_ahead(place: vec2<f32>) -> vec2<f32> {
    let inside = clamp(place, vec2<f32>(0.0), vec2<f32>(1.0));
    let clip = vec2<f32>(2.0, -2.0) * (inside - 0.5);
    let ahead = water.optics.z / max(exact_depth(inside), 1e-20);
    return ahead * vec2<f32>(1.0, frame.forward.z + clip.x * frame.right.z + clip.y * frame.up.z);
}

// How far ahead of the eye nothing is any more.
const NOTHING_AHEAD: f32 = 1e9;

// The last place on the way from one place of the screen to another that is of use to a surface `level` metres above the eye and
// `ahead` of it. What is below it is hidden by banks and by whatever is nearer than it, and ends where there is nothing; what it
// mirrors (`up`), by far banks alone, as the mirrored picture shows what is behind them there, not their foot, which is clipped. A
// bank in one piece is found to a 32nd of the way.
fn last_place(here: vec2<f32>, there: vec2<f32>, level: f32, ahead: f32, up: bool) -> vec2<f32> {
    var low = 0.0;
    var high = 1.0;
    var middle = 1.0;
    for (var i = 0; i < 6; i++) {
        let found = scene_ahead(mix(here, there, middle));
        let is_near = found.x < ahead;
        let is_bank = found.y > level && found.y < NOTHING_AHEAD;
        let is_end = !up && found.x >= NOTHING_AHEAD;
        if select(is_near || is_bank || is_end, is_bank && !is_near, up) {
            high = middle;
        } else {
            low = middle;
        }
        if low == 1.0 {
            break;
        }
        middle = 0.5 * (low + high);
    }
    return mix(here, there, low);
}

// A place of the screen, or the middle of its pixel where a picture of what is more than `ahead` metres ahead of the eye would mix
// in what is nearer, or nothing: behind a crest the mixture is a place in the air before the water, in the crest's colour.
fn unmixed(place: vec2<f32>, ahead: f32) -> vec2<f32> {
    let size = vec2<f32>(textureDimensions(scene));
    let around = depths_around(place, size);
    let nearest = water.optics.z / max(most_of(around), 1e-20);
    let farthest = water.optics.z / max(least_of(around), 1e-20);
    let is_mixed = nearest < 0.99 * ahead || (farthest >= NOTHING_AHEAD && nearest < NOTHING_AHEAD);
    return select(place, (floor(place * size) + 0.5) / size, is_mixed);
}

// The part of the way from a place of the screen to another that is on it.
fn way_on_screen(here: vec2<f32>, there: vec2<f32>) -> f32 {
    let way = there - here;
    let room = select(here, 1.0 - here, way > vec2<f32>(0.0)) / max(abs(way), vec2<f32>(1e-9));
    return clamp(min(room.x, room.y), 0.0, 1.0);
}

// How far a place is outside of the screen, in parts of it.
fn outside(place: vec2<f32>) -> f32 {
    let beyond = max(abs(place - 0.5) - 0.5, vec2<f32>(0.0));
    return max(beyond.x, beyond.y);
}

// Ripples too small to be seen make the mirrored picture soft: what of their variance does so, and how far apart in their
// slopes the picture is read, in deviations.
const SOFTENING: f32 = 0.03;
const TAP: f32 = 0.24;
const TAPS: i32 = 10;
// exp(-TAP * TAP / 2).
const BELL: f32 = 0.9716106;

// The mirrored picture at a place of the screen and above what it shows there, as facets see it whose slopes vary about those
// of `normal` by `variance`. Facets that lean towards the eye move what they mirror by twice as much, upwards; those that lean
// away are hidden, or mirror other waves, and those that lean aside hardly move it: a row of places is enough. Those that show
// a bank on this side of the water, which is `distance` metres away, are passed over: where all do, what still water
// mirrors takes their place, that at `here`.
fn blurred(
    here: vec2<f32>, image: vec3<f32>, ray: vec3<f32>, normal: vec3<f32>, variance: f32, distance: f32,
) -> vec4<f32> {
    if water.optics.w == 0.0 || image.z == 0.0 {
        return textureSampleLevel(mirrored, smooth_sampler, image.xy, 0.0);
    }
    let ahead = ray.xy / max(length(ray.xy), 1e-6);
    let lean = TAP * sqrt(SOFTENING * variance);
    let leaning = normalize(vec3<f32>(normal.xy / max(normal.z, 0.1) - lean * ahead, 1.0));
    let moved = reflect(ray, leaning);
    let still = reflect(ray, normal);
    let step = projected(vec3<f32>(moved.xy, -moved.z) * 1e6).xy - projected(vec3<f32>(still.xy, -still.z) * 1e6).xy;
    let near = told_distance(0.9 * distance);
    var weights = 0.0;
    var sum = vec4<f32>(0.0);
    // The bell curve, without its exponential: from one place to the next it falls by a factor that falls by a factor.
    var bell = 1.0;
    var fall = BELL;
    for (var i = 0; i < TAPS; i++) {
        let found = textureSampleLevel(mirrored, smooth_sampler, image.xy + f32(i) * step, 0.0);
        let weight = select(bell, 0.0, found.a > 0.02 && found.a < near);
        sum += weight * found;
        weights += weight;
        bell *= fall;
        fall *= BELL * BELL;
    }
    if weights < 0.1 {
        let rest = 0.1 - weights;
        sum += rest * textureSampleLevel(mirrored, smooth_sampler, here, 0.0);
        weights += rest;
    }
    return sum / weights;
}

// The pixels over which a coast is drawn smooth: where it is less there is nothing to smooth, and where it is more the few places
// that are read show one by one.
const COAST_PIXELS: vec2<f32> = vec2<f32>(1.0, 40.0);
const COAST_TAPS: i32 = 16;

// Ground around a place of water whose bed is unknown: its colour, its depth below the water in metres, and how much
// of all that is around it is ground, 0 to 1.
struct Coast {
    colour: vec3<f32>,
    depth: f32,
    share: f32,
}

fn coast_at(here: vec2<f32>, p: vec3<f32>) -> Coast {
    let reach = water.body.w;
    let east = projected(p + vec3<f32>(reach, 0.0, 0.0)).xy - here;
    let north = projected(p + vec3<f32>(0.0, reach, 0.0)).xy - here;
    let size = vec2<f32>(textureDimensions(scene));
    let across = (abs(east) + abs(north)) * size;
    let pixels = max(across.x, across.y);
    if pixels < COAST_PIXELS.x || pixels > COAST_PIXELS.y {
        return Coast(vec3<f32>(0.0), 0.0, 0.0);
    }
    let ahead = dot(p, frame.forward.xyz);
    var colour = vec3<f32>(0.0);
    var depth = 0.0;
    var ground = 0.0;
    var all = 0.0;
    var turn = vec2<f32>(1.0, 0.0);
    for (var i = COAST_TAPS - 1; i >= 0; i--) {
        // From the rim on in: out at sea the first few, in all directions, find no ground.
        if i == COAST_TAPS - 6 && ground == 0.0 {
            break;
        }
        // Spread evenly over a disc, by the golden angle.
        turn = vec2<f32>(-0.737369 * turn.x - 0.675490 * turn.y, 0.675490 * turn.x - 0.737369 * turn.y);
        let far = sqrt((f32(i) + 0.5) / f32(COAST_TAPS));
        // The middle of a pixel, where no colour of the sky beside it is mixed in.
        let place = (floor((here + far * (turn.x * east + turn.y * north)) * size) + 0.5) / size;
        let weight = 1.0 - 0.5 * far;
        let found = scene_ahead(place);
        // What is before or behind all that is around is none of it.
        if max(abs(found.x - ahead), abs(found.y - p.z)) < 3.0 * reach {
            colour += weight * textureSampleLevel(scene, smooth_sampler, place, 0.0).rgb;
            depth += weight * max(p.z - found.y, 0.0);
            ground += weight;
        }
        all += weight;
    }
    let fade = 1.0 - smoothstep(0.5 * COAST_PIXELS.y, COAST_PIXELS.y, pixels);
    return Coast(colour / max(ground, 1e-6), depth / max(ground, 1e-6), fade * ground / all);
}

@fragment
fn water_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    let p = shaded.from_eye;
    let distance = length(p);
    let ray = p / distance;
    let here = shaded.clip.xy / vec2<f32>(textureDimensions(scene));
    let ahead = dot(ray, frame.forward.xyz);

    let still = normal_of(shaded);
    let slope = wave_slope(p.xy, dpdx(p.xy), dpdy(p.xy));
    if is_left_out(shaded) {
        discard;
    }
    // Waves never turn a surface away from the eye.
    var normal = normalize(vec3<f32>(still.xy - slope.xy * still.z, still.z));
    let from_below = dot(ray, still) > 0.0;
    if from_below {
        normal = -normal;
    }
    let facing = max(-dot(ray, normal), 0.0);

    // Through the surface. The bed's depth below it is that along the ray not bent, then that at the place it bends to.
    let straight = water.optics.z / max(exact_depth(here), 1e-20) / ahead;
    var depth = max(straight - distance, 0.0) * abs(ray.z);
    let bent = select(refract(ray, normal, water.optics.y), ray, from_below);
    let down = max(abs(bent.z), 0.05);
    let bed = projected(p + bent * min(depth / down, 1e7));
    var place = here;
    if !from_below && bed.z > 0.0 && straight * ahead < NOTHING_AHEAD {
        // What stands before the surface is not seen through it, nor what is beside a bed's end.
        let end = mix(here, bed.xy, way_on_screen(here, bed.xy));
        let forward = dot(p, frame.forward.xyz);
        place = unmixed(last_place(here, end, p.z, forward, false), forward);
        let other_ray = ray_through(place);
        let other_depth = p.z - other_ray.z * scene_distance(place, dot(other_ray, frame.forward.xyz));
        // Behind a crest above the eye there may be the sky alone.
        depth = select(max(other_depth, 0.0), depth, other_ray.z > 0.0);
    }
    var seen = textureSampleLevel(scene, smooth_sampler, place, 0.0).rgb;
    if depth > 1e6 && !from_below {
        // Along a coast without a bed it is taken to go down from the ground, whose outline would have the corners of its samples.
        let coast = coast_at(here, p);
        let away = clamp(1.0 - 2.0 * coast.share, 0.0, 1.0);
        if coast.share > 0.0 {
            seen = coast.colour;
            depth = coast.depth + 3.0 * away * away / water.absorption.g;
        }
    }
    // Light comes down, and up to the eye; seen from below it is the way to the surface that counts.
    let way = select(depth * (1.0 + 1.0 / down), distance, from_below);
    let left = exp(-water.absorption.rgb * way);
    let body = lit(water.body.rgb, vec3<f32>(0.0, 0.0, 1.0));
    let through = mix(body, seen, left);
    if from_below {
        return encoded(through);
    }

    // From the surface.
    let shore = 1.0 - exp(-depth / max(water.absorption.w, 1e-12));
    let rest = 1.0 - facing;
    let fresnel = shore * (water.optics.x + (1.0 - water.optics.x) * rest * rest * rest * rest * rest);
    var back = reflect(ray, normal);
    // A wave's far side mirrors what a lower wave before it does: nearly the horizon.
    back = normalize(vec3<f32>(back.xy, abs(back.z)));
    var image = projected(vec3<f32>(back.xy, -back.z) * 1e6);
    if image.z > 0.0 {
        image = vec3<f32>(last_place(here, image.xy, p.z, dot(p, frame.forward.xyz), true), 1.0);
    }
    let found = blurred(here, image, ray, normal, slope.z, distance);
    // Past the edges nothing was drawn: for as far as waves reach, the picture is taken to go on there as it came.
    let lost = select(1.0, smoothstep(0.1, 0.3, outside(image.xy)), image.z > 0.0);
    // Still water mirrors the sun's disc, where alpha says that there is sky; waves break it into the glitter below.
    let angle = 2.0 * length(frame.up.xyz) / f32(textureDimensions(scene).y);
    let is_open = 1.0 - mix(min(2.0 * found.a, 1.0), 0.0, lost);
    let disc = sun_towards(back, angle) * (is_open * (1.0 - water.optics.w));
    let above = mix(found.rgb, sky_towards(back), lost) + disc;
    let glitter = water.optics.w * SUNLIGHT * glitter_of(ray, normal, slope.z);
    let colour = mix(hazed(through, p), above + glitter * vec3<f32>(1.08, 1.04, 0.97), fresnel);
    return encoded(colour);
}
