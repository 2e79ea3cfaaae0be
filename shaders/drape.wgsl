// Imagery on terrain: the finest tiles that are there, found by going down a quadtree from a tile that holds the whole
// diamond. Prepended to the terrain's shader. Its Rust twin is client/src/render/drape.rs.
//
// A level is right where a texel is as large as a pixel. Between two levels both are mixed by how near each is to that, so
// that none begins with an edge; a tile that has just come takes its parent's place by and by.

// Of each tile: x, its place among the pictures; y, how much of it is seen and not of its parent, in 255ths; z and w, its
// four children, two in each, 0 where one is not there. The first is no tile.
@group(2) @binding(0) var nodes: texture_2d<u32>;
@group(2) @binding(1) var pictures: texture_2d_array<f32>;
@group(2) @binding(2) var picture_sampler: sampler;

// Texels of a tile, of its picture, and of the gutter on each side of it.
const INNER: f32 = 248.0;
const SIDE: f32 = 256.0;
const GUTTER: f32 = 4.0;
// Pictures in a row of a sheet, and rows of a whole one.
const ACROSS: u32 = 8u;

fn node_at(number: u32) -> vec4<u32> {
    return textureLoad(nodes, vec2<i32>(i32(number & 63u), i32(number >> 6u)), 0);
}

// What a tile's picture shows at a place in the tile, from 0 to 1 east and north, which moves so much from pixel to pixel.
fn picture_at(node: vec4<u32>, place: vec2<f32>, right: vec2<f32>, down: vec2<f32>) -> vec4<f32> {
    let cell = vec2<f32>(f32(node.x % ACROSS), f32(node.x / ACROSS % ACROSS));
    // The gutter holds what is next to the tile; what is farther away never counts.
    let inside = clamp(place, vec2<f32>(-3.0 / INNER), vec2<f32>(1.0 + 3.0 / INNER));
    // Rows run from north to south.
    let texel = cell * SIDE + GUTTER + INNER * vec2<f32>(inside.x, 1.0 - inside.y);
    // Where there are few, a sheet has fewer rows.
    let sheet = vec2<f32>(textureDimensions(pictures));
    let scale = vec2<f32>(INNER, -INNER) / sheet;
    return textureSampleGrad(
        pictures, picture_sampler, texel / sheet, i32(node.x / (ACROSS * ACROSS)), right * scale, down * scale,
    );
}

// The imagery at a place in a tile: light, multiplied by how much it hides of what is below it, and that.
fn imagery_at(number: u32, start: vec2<f32>, right: vec2<f32>, down: vec2<f32>) -> vec4<f32> {
    if number == 0u {
        return vec4<f32>(0.0);
    }
    // Texels from pixel to pixel: along the shorter way, where the sampler takes so many steps along the longer one.
    let steps = vec2<f32>(length(right), length(down)) * INNER;
    let longest = max(steps.x, steps.y);
    let texels = max(min(steps.x, steps.y), longest / frame.drape.z);
    // Levels to go down.
    var finer = -log2(max(texels, 1e-12));
    var node = node_at(number);
    var place = start;
    var scale = 1.0;
    var parent = node;
    var parent_place = place;
    var weight = 1.0;
    for (var level = 0; level < 17; level++) {
        // Not by `select`, which WebGL2 lacks for vectors of integers.
        let quarter = vec2<u32>(place >= vec2<f32>(0.5));
        let pair = select(node.z, node.w, quarter.y == 1u);
        let child = select(pair & 0xffffu, pair >> 16u, quarter.x == 1u);
        if finer <= 0.0 || child == 0u {
            break;
        }
        parent = node;
        parent_place = place;
        node = node_at(child);
        weight = min(finer, 1.0) * f32(node.y) / 255.0;
        place = 2.0 * place - vec2<f32>(quarter);
        scale *= 2.0;
        finer -= 1.0;
    }
    let colour = picture_at(node, place, right * scale, down * scale);
    if weight >= 1.0 {
        return colour;
    }
    let coarse = picture_at(parent, parent_place, 0.5 * right * scale, 0.5 * down * scale);
    return mix(coarse, colour, weight);
}
