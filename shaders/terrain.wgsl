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

// The colour of a height, or of a slope. `pixel_value`: how much more it is from this pixel to the next.
fn albedo_at(value: f32, pixel_value: f32, normal_up: f32) -> vec3<f32> {
    if layer.is_water != 0.0 {
        return frame.water.rgb;
    }
    if frame.options.z != 0.0 {
        return vec3<f32>(select(1.0, 0.5, frame.style.x == 0.0));
    }
    // Rock shows on steep ground.
    let steep = select(1.0, mix(0.7, 1.0, smoothstep(0.45, 0.9, normal_up)), frame.style.z != 0.0);
    let land = steep * land_colour((value - layer.land_base) * layer.per_height);
    if layer.per_depth == 0.0 {
        return land;
    }
    // The shore is as wide as a pixel, so that it does not flicker; where colours are to be read they are not mixed.
    let sea = sea_colour(-value * layer.per_depth);
    let shore = select(step(0.0, value), clamp(value / pixel_value + 0.5, 0.0, 1.0), frame.style.x == 0.0);
    return mix(sea, land, shore);
}

// A colour in the light that the look asks for.
fn shaded_colour(albedo: vec3<f32>, normal: vec3<f32>) -> vec3<f32> {
    if frame.style.x == 0.0 {
        return lit(albedo, normal);
    }
    if frame.style.x == 2.0 || layer.is_water != 0.0 {
        return albedo;
    }
    return from_srgb(to_srgb(albedo) * max(dot(normal, frame.sun.xyz), 0.0));
}

// Degrees from the level, of heights that are not multiplied.
fn slope_of(shaded: Shaded) -> f32 {
    let across = length(shaded.about.xy);
    return degrees(atan2(across, sqrt(max(1.0 - across * across, 0.0))));
}

// Six hues in turn, so that neighbouring levels differ.
fn level_tint(level: f32) -> vec3<f32> {
    let turn = level / 6.0 + vec3<f32>(0.0, 0.333, 0.667);
    return 0.5 + 0.5 * cos(6.2831853 * turn);
}

// Heights that are multiplied by more than this are lit softly as if by this: almost all ground would face sideways, where
// neither the sun nor the sky overhead reaches it, and be black.
const LIT_EXAGGERATION: f32 = 2.0;

// The unit normal that light falls on.
fn lit_normal(shaded: Shaded) -> vec3<f32> {
    if frame.style.x != 0.0 || layer.exaggeration <= LIT_EXAGGERATION {
        return normal_of(shaded);
    }
    return stretched_normal(shaded, LIT_EXAGGERATION);
}

fn terrain_colour(shaded: Shaded) -> vec4<f32> {
    let normal = lit_normal(shaded);
    var imagery = imagery_at(shaded.tile, shaded.drape, dpdx(shaded.drape), dpdy(shaded.drape)) * frame.drape.y;
    let height = (frame.sun.w + shaded.from_eye.z) / layer.exaggeration;
    let value = select(height, slope_of(shaded), frame.style.y != 0.0);
    var albedo = albedo_at(value, max(fwidth(height), 1e-6), normal.z);
    if frame.options.y != 0.0 {
        let tint = level_tint(round(shaded.about.z));
        albedo = mix(albedo, tint, 0.5);
        // Levels are those of the ground's triangles: they show through whatever lies on it.
        imagery = vec4<f32>(mix(imagery.rgb, tint * imagery.a, 0.5), imagery.a);
    }
    // Pictures of the ground have its light in them already: how much more they get is for the viewer to say.
    let ground = shaded_colour(albedo, normal) * (1.0 - imagery.a);
    let photo = imagery.rgb * mix(vec3<f32>(1.0), shaded_colour(vec3<f32>(1.0), normal), frame.drape.x);
    return encoded(hazed(ground + photo, shaded.from_eye));
}

@fragment
fn terrain_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    let colour = terrain_colour(shaded);
    if is_left_out(shaded) {
        discard;
    }
    return colour;
}

// Seen in water: what is below its surface is not. Alpha tells how far away it is; of ground from below, which no light comes
// from to where there is ground, that it is as near as can be.
@fragment
fn mirrored_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    let colour = terrain_colour(shaded);
    if shaded.from_eye.z < frame.water.w || is_left_out(shaded) {
        discard;
    }
    let is_below = dot(normal_of(shaded), shaded.from_eye) > 0.0;
    return vec4<f32>(colour.rgb, select(told_distance(length(shaded.from_eye)), 0.5, is_below));
}

// Triangles whose sides are lines of full strength are so large on the screen, in pixels.
const WIRE_PIXELS: f32 = 8.0;

// The sides of triangles. Lines are a pixel wide, however small the triangles are: where they would be all that is seen, they are as
// faint as they would be thin if they grew with the triangles, and the ground shows through.
@fragment
fn wire_fragment(shaded: Shaded) -> @location(0) vec4<f32> {
    if is_left_out(shaded) {
        discard;
    }
    let pixels = shaded.triangle / (length(shaded.from_eye) * frame.drape.w);
    let colour = encoded(hazed(vec3<f32>(0.02), shaded.from_eye));
    return vec4<f32>(colour.rgb, min(pixels / WIRE_PIXELS, 1.0));
}
