// Surfaces, of terrain and of water: from heights on a lattice to places on the screen. Prepended to their shaders.

struct Vertex {
    // The same for all diamonds: doubled local coordinates.
    @location(0) place: vec2<u32>,
    // The diamond's own: height in quanta, and the normal's east and north.
    @location(1) height: i32,
    @location(2) normal: vec2<f32>,
    // The instance's: lattice point (0, 0) relative to the reference point; lattice steps of u and v.
    @location(3) origin: vec2<i32>,
    @location(4) axes: vec4<i32>,
    // x: the level. y: the moment to draw, in ticks. z: ticks that a motion takes. w: the first tile of imagery. Of irregular
    // triangles that are seen in some pixels, y and z: the bits of the two numbers of their share.
    @location(5) about: vec4<i32>,
    // Where in that tile a place lies: xy the eye, zw what a metre is.
    @location(10) drape: vec4<f32>,
    // How large its triangles are, in metres.
    @location(11) triangle: f32,
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
    @location(5) about: vec4<i32>,
    @location(10) drape: vec4<f32>,
    @location(11) triangle: f32,
}

struct Shaded {
    @builtin(position) @invariant clip: vec4<f32>,
    // xy: the normal's east and north. z: the level.
    @location(0) about: vec3<f32>,
    // In metres. A plane's is interpolated without error, as its distance would not be.
    @location(1) from_eye: vec3<f32>,
    // Where in the first tile of imagery, from 0 to 1 east and north, and which that is.
    @location(2) drape: vec2<f32>,
    @location(3) @interpolate(flat) tile: u32,
    // Where irregular triangles are seen: in pixels whose number is not below the first, and below the second.
    @location(4) @interpolate(flat) share: vec2<f32>,
    // How large the triangles are, in metres.
    @location(5) @interpolate(flat) triangle: f32,
}

// A lattice point, relative to the reference point, drawn `lift` quanta above its own height. Up to the conversion to
// f32 all is exact, and from there on a function of the lattice point, the height and the lift alone: so two diamonds
// give a point that they share the same bits, whether they move or not.
fn placed(
    lattice: vec2<i32>, height: i32, lift: f32, normal: vec2<f32>, about: vec4<i32>, drape: vec4<f32>, triangle: f32,
) -> Shaded {
    let across = vec2<f32>(lattice) * layer.cell + layer.offset;
    let still = f32(height - layer.height) * layer.quantum + layer.up_offset;
    let up = select(still + lift * layer.quantum, still, lift == 0.0);
    let from_eye = vec3<f32>(across, up);
    return Shaded(
        frame.clip_from_eye * vec4<f32>(from_eye, 1.0),
        vec3<f32>(normal, f32(about.x)),
        from_eye,
        drape.xy + drape.zw * across,
        u32(about.w),
        bitcast<vec2<f32>>(about.yz),
        triangle,
    );
}

fn shaded(vertex: Vertex, lift: f32, normal: vec2<f32>) -> Shaded {
    let p = vec2<i32>(vertex.place);
    let lattice = vertex.origin + ((vertex.axes.xy * p.x + vertex.axes.zw * p.y) >> vec2<u32>(1u));
    return placed(lattice, vertex.height, lift, normal, vertex.about, vertex.drape, vertex.triangle);
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
    let lattice = corner.origin + corner.place;
    return placed(lattice, corner.height, 0.0, corner.normal, corner.about, corner.drape, corner.triangle);
}

// Whether triangles are seen in some pixels alone: see client/src/morph.rs.
override IN_SOME_PIXELS: bool = false;

// Whether a pixel is one of those that do not show them. Its number: interleaved gradient noise (Jimenez 2014), whose values are
// spread evenly among pixels that are near one another.
fn is_left_out(shaded: Shaded) -> bool {
    let number = fract(52.9829189 * fract(dot(floor(shaded.clip.xy), vec2<f32>(0.06711056, 0.00583715))));
    return IN_SOME_PIXELS && (number < shaded.share.x || number >= shaded.share.y);
}

// The unit normal, of the surface if its heights are multiplied by so much.
fn stretched_normal(shaded: Shaded, exaggeration: f32) -> vec3<f32> {
    let across = shaded.about.xy;
    let up = sqrt(max(1.0 - dot(across, across), 0.0));
    return normalize(vec3<f32>(across * exaggeration, up));
}

// The unit normal, of the stretched surface.
fn normal_of(shaded: Shaded) -> vec3<f32> {
    return stretched_normal(shaded, layer.exaggeration);
}
