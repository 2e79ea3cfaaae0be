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
    return encoded(sky_towards(normalize(ray.direction)));
}
