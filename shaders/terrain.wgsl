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
    @location(5) level: vec2<i32>,
}

struct Shaded {
    @builtin(position) @invariant clip: vec4<f32>,
    // xy: the normal's east and north. z: metres up from the eye. w: metres from the eye.
    @location(0) about: vec4<f32>,
    @location(1) level: f32,
}

// Up to the conversion to f32 all is exact, and from there on a function of the lattice point and the
// height alone: so two diamonds give a point that they share the same bits.
@vertex
fn terrain_vertex(vertex: Vertex) -> Shaded {
    let p = vec2<i32>(vertex.place);
    let lattice = vertex.origin + ((vertex.axes.xy * p.x + vertex.axes.zw * p.y) >> vec2<u32>(1u));
    let across = vec2<f32>(lattice) * layer.cell + layer.offset;
    let up = f32(vertex.height - layer.height) * layer.quantum + layer.up_offset;
    let from_eye = vec3<f32>(across, up);
    return Shaded(
        frame.clip_from_eye * vec4<f32>(from_eye, 1.0),
        vec4<f32>(vertex.normal, up, length(from_eye)),
        f32(vertex.level.x),
    );
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
