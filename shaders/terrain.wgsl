// Terrain: coloured by height and lit by the sun.

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
    if layer.is_water != 0.0 {
        return frame.water.rgb;
    }
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

fn terrain_colour(shaded: Shaded) -> vec4<f32> {
    let normal = normal_of(shaded);
    let imagery = imagery_at(shaded.tile, shaded.drape, dpdx(shaded.drape), dpdy(shaded.drape)) * frame.drape.y;
    let height = (frame.sun.w + shaded.from_eye.z) / layer.exaggeration;
    var albedo = albedo_at(height, max(fwidth(height), 1e-6), normal.z);
    if frame.options.y != 0.0 {
        albedo = mix(albedo, level_tint(round(shaded.about.z)), 0.5);
    }
    // Pictures of the ground have its light in them already: how much more they get is for the viewer to say.
    let light = lit(vec3<f32>(1.0), normal);
    let colour = albedo * light * (1.0 - imagery.a) + imagery.rgb * mix(vec3<f32>(1.0), light, frame.drape.x);
    return encoded(hazed(colour, shaded.from_eye));
}

@fragment
fn terrain_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    return terrain_colour(shaded);
}

// Seen in water: what is below its surface is not.
@fragment
fn mirrored_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    let colour = terrain_colour(shaded);
    if shaded.from_eye.z < frame.water.w {
        discard;
    }
    return colour;
}

// The sides of triangles.
@fragment
fn wire_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    return encoded(hazed(vec3<f32>(0.02), shaded.from_eye));
}
