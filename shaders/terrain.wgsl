// Terrain: a grid of heights, coloured by height and lit by the sun.

struct Vertex {
    // The same for all diamonds: doubled local coordinates.
    @location(0) place: vec2<u32>,
    // The diamond's own: height in quanta, and the normal's east and north.
    @location(1) height: i32,
    @location(2) normal: vec2<f32>,
    // The instance's: lattice point (0, 0) relative to the reference point; lattice steps of u and v.
    @location(3) origin: vec2<i32>,
    @location(4) axes: vec4<i32>,
    // x: the level. y: the moment to draw, in ticks. z: ticks that a motion takes.
    @location(5) about: vec3<i32>,
}

// The motion of a point: see client/src/morph.rs.
struct Motion {
    // Quanta above its own height, from and to.
    @location(6) lift: vec2<f32>,
    // The normal's east and north, from and to.
    @location(7) from_normal: vec2<f32>,
    @location(8) to_normal: vec2<f32>,
    // The moment of its start, in ticks.
    @location(9) start: i32,
}

// A vertex of irregular triangles.
struct Corner {
    // Lattice steps from the diamond's centre.
    @location(0) place: vec2<i32>,
    // Height in quanta, and the normal's east and north.
    @location(1) height: i32,
    @location(2) normal: vec2<f32>,
    // The instance's: the centre relative to the reference point. The others are as above.
    @location(3) origin: vec2<i32>,
    @location(4) axes: vec4<i32>,
    @location(5) about: vec3<i32>,
}

struct Shaded {
    @builtin(position) @invariant clip: vec4<f32>,
    // xy: the normal's east and north. z: metres up from the eye. w: metres from the eye.
    @location(0) about: vec4<f32>,
    @location(1) level: f32,
}

// A lattice point, relative to the reference point, drawn `lift` quanta above its own height. Up to the conversion to
// f32 all is exact, and from there on a function of the lattice point, the height and the lift alone: so two diamonds
// give a point that they share the same bits, whether they move or not.
fn placed(lattice: vec2<i32>, height: i32, lift: f32, normal: vec2<f32>, level: i32) -> Shaded {
    let across = vec2<f32>(lattice) * layer.cell + layer.offset;
    let still = f32(height - layer.height) * layer.quantum + layer.up_offset;
    let up = select(still + lift * layer.quantum, still, lift == 0.0);
    let from_eye = vec3<f32>(across, up);
    return Shaded(
        frame.clip_from_eye * vec4<f32>(from_eye, 1.0),
        vec4<f32>(normal, up, length(from_eye)),
        f32(level),
    );
}

fn shaded(vertex: Vertex, lift: f32, normal: vec2<f32>) -> Shaded {
    let p = vec2<i32>(vertex.place);
    let lattice = vertex.origin + ((vertex.axes.xy * p.x + vertex.axes.zw * p.y) >> vec2<u32>(1u));
    return placed(lattice, vertex.height, lift, normal, vertex.about.x);
}

@vertex
fn terrain_vertex(vertex: Vertex) -> Shaded {
    return shaded(vertex, 0.0, vertex.normal);
}

// On the way from one cut to the next. At the end of its way a point is where it goes to, bit for bit.
@vertex
fn terrain_morph_vertex(vertex: Vertex, motion: Motion) -> Shaded {
    let age = vertex.about.y - motion.start;
    let t = clamp(f32(age) / f32(vertex.about.z), 0.0, 1.0);
    let weight = t * t * (3.0 - 2.0 * t);
    let on_the_way = motion.lift.x + (motion.lift.y - motion.lift.x) * weight;
    let lift = select(on_the_way, motion.lift.y, age >= vertex.about.z);
    return shaded(vertex, lift, mix(motion.from_normal, motion.to_normal, weight));
}

@vertex
fn tin_vertex(corner: Corner) -> Shaded {
    return placed(corner.origin + corner.place, corner.height, 0.0, corner.normal, corner.about.x);
}

// Linear interpolation between the colours on both sides of t.
fn land_colour(t: f32) -> vec3<f32> {
    var colour = frame.land[0].rgb;
    for (var i = 1; i < 8; i++) {
        let low = frame.land[i - 1].w;
        let high = frame.land[i];
        colour = mix(colour, high.rgb, clamp((t - low) / (high.w - low), 0.0, 1.0));
    }
    return colour;
}

fn sea_colour(t: f32) -> vec3<f32> {
    var colour = frame.sea[0].rgb;
    for (var i = 1; i < 4; i++) {
        let low = frame.sea[i - 1].w;
        let high = frame.sea[i];
        colour = mix(colour, high.rgb, clamp((t - low) / (high.w - low), 0.0, 1.0));
    }
    return colour;
}

// `pixel_height`: metres of height from this pixel to the next.
fn albedo_at(height: f32, pixel_height: f32, normal_up: f32) -> vec3<f32> {
    if frame.options.z != 0.0 {
        return vec3<f32>(0.5);
    }
    // Rock shows on steep ground.
    let steep = mix(0.7, 1.0, smoothstep(0.45, 0.9, normal_up));
    let land = steep * land_colour((height - layer.land_base) * layer.per_height);
    if layer.per_depth == 0.0 {
        return land;
    }
    // The shore is as wide as a pixel, so that it does not flicker.
    let sea = sea_colour(-height * layer.per_depth);
    return mix(sea, land, clamp(height / pixel_height + 0.5, 0.0, 1.0));
}

// Six hues in turn, so that neighbouring levels differ.
fn level_tint(level: f32) -> vec3<f32> {
    let turn = level / 6.0 + vec3<f32>(0.0, 0.333, 0.667);
    return 0.5 + 0.5 * cos(6.2831853 * turn);
}

@fragment
fn terrain_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    let across = shaded.about.xy;
    let up = sqrt(max(1.0 - dot(across, across), 0.0));
    let normal = normalize(vec3<f32>(across * layer.exaggeration, up));
    let height = (frame.sun.w + shaded.about.z) / layer.exaggeration;
    var albedo = albedo_at(height, max(fwidth(height), 1e-6), normal.z);
    if frame.options.y != 0.0 {
        albedo = mix(albedo, level_tint(round(shaded.level)), 0.5);
    }
    return encoded(mix(lit(albedo, normal), frame.horizon.rgb, haze_to(shaded.about.z, shaded.about.w)));
}

// The sides of triangles.
@fragment
fn wire_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    return encoded(mix(vec3<f32>(0.02), frame.horizon.rgb, haze_to(shaded.about.z, shaded.about.w)));
}
