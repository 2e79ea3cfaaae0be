// The sky, wherever nothing was drawn.

struct Ray {
    @builtin(position) clip: vec4<f32>,
    @location(0) direction: vec3<f32>,
}

// One triangle that holds the whole picture, infinitely far away: depth is reversed, so that is 0.
@vertex
fn sky_vertex(@builtin(vertex_index) index: u32) -> Ray {
    let x = select(-1.0, 3.0, index == 1u);
    let y = select(-1.0, 3.0, index == 2u);
    let direction = frame.forward.xyz + x * frame.right.xyz + y * frame.up.xyz;
    return Ray(vec4<f32>(x, y, 0.0, 1.0), direction);
}

@fragment
fn sky_fragment(ray: Ray) -> @location(0) vec4<f32> {
    let direction = normalize(ray.direction);
    let pixel = max(length(dpdx(direction)), length(dpdy(direction)));
    let sky = sky_towards(direction);
    // Of what is mirrored, water adds the sun by itself: brighter than a texture holds, where alpha says that nothing hides
    // it, and once only where waves break it into glitter.
    if frame.water.w > -1e29 {
        return vec4<f32>(encoded(sky).rgb, 0.0);
    }
    return encoded(sky + sun_towards(direction, pixel));
}
