//! Which tiles a view wants: a pure function of the camera and of where something is drawn.

use crate::camera::{Bounds, Camera};
use diamantina_protocol::texture::{Coverage, Texture, Tile};
use foldhash::fast::RandomState;
use std::collections::HashMap;

/// The most tiles of a frame, whatever the memory: the GPU tells them apart by 12 bits.
pub(super) const TILES_MAX: usize = 4000;

/// The finest tile that holds a rectangle of the frame wholly; none where they do not touch.
#[must_use]
pub fn within(texture: &Texture, min: [f64; 2], max: [f64; 2]) -> Option<Tile> {
    let finest = texture.levels() - 1;
    let grid = texture.grid(finest);
    let extent = texture.extent(finest);
    let mut corners = [[0u32; 2]; 2];
    for axis in 0..2 {
        let [low, high] = [min, max].map(|corner| (corner[axis] - texture.origin[axis]) / extent[axis]);
        // Beyond its last texel, too, there is none.
        let end = f64::from(texture.size[axis]) * texture.texel[axis] / extent[axis];
        if high < 0.0 || low > end {
            return None;
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the grid")]
        let tile = |at: f64| at.clamp(0.0, f64::from(grid[axis] - 1)) as u32;
        (corners[0][axis], corners[1][axis]) = (tile(low), tile(high));
    }
    let [[x0, y0], [x1, y1]] = corners;
    // As many levels up as it takes for all corners to lie in one.
    let differing = (x0 ^ x1) | (y0 ^ y1);
    let up = u32::BITS - differing.leading_zeros();
    Some(Tile { level: finest - up, x: x0 >> up, y: y0 >> up })
}

/// The tiles wanted to see terrain drawn in `boxes` with texels no larger than a pixel, as far as the texture has such: most
/// needed first, so that any number of the first ones holds the parents of each; `most` at most. Nothing nearer to the eye
/// than `nearest` metres is drawn.
#[must_use]
pub fn wanted(
    texture: &Texture,
    coverage: &Coverage,
    camera: &Camera,
    boxes: &[Bounds],
    nearest: f64,
    most: usize,
) -> Vec<Tile> {
    let mut search = Search {
        texture,
        coverage,
        camera,
        planes: camera.planes(),
        nearest,
        pixels_per_radian: camera.pixels_per_radian(),
        needs: HashMap::default(),
    };
    for bounds in boxes {
        search.look_at(bounds);
    }
    let mut wanted: Vec<(f64, Tile)> = search.needs.into_iter().map(|(tile, need)| (need, tile)).collect();
    wanted.sort_unstable_by(|(a, tile), (b, other)| b.total_cmp(a).then(tile.cmp(other)));
    wanted.truncate(most);
    wanted.into_iter().map(|(_, tile)| tile).collect()
}

struct Search<'a> {
    texture: &'a Texture,
    coverage: &'a Coverage,
    camera: &'a Camera,
    planes: [crate::camera::Plane; 5],
    nearest: f64,
    pixels_per_radian: f64,
    /// Of each wanted tile, how many pixels a texel of its parent would take.
    needs: HashMap<Tile, f64, RandomState>,
}

impl Search<'_> {
    fn look_at(&mut self, bounds: &Bounds) {
        let [min, max] = [bounds.min, bounds.max].map(|corner| [corner.x, corner.y]);
        let Some(mut start) = within(self.texture, min, max) else { return };
        // Where the image has nothing there is no such tile, but perhaps a coarser one.
        while !self.coverage.has(start) {
            let Some(parent) = start.parent() else { return };
            start = parent;
        }
        let need = self.visit(start, bounds);
        self.need_parents(start, need);
    }

    /// Pixels that a texel of a level takes at the point of a box that is nearest to the eye.
    fn pixels(&self, level: u32, bounds: &Bounds) -> f64 {
        let [x, y] = self.texture.texel_at(level);
        x.max(y) * self.pixels_per_radian / bounds.distance(self.camera.eye).max(self.nearest)
    }

    /// Wants a tile that is seen in a box, and what of its descendants is needed there.
    fn visit(&mut self, tile: Tile, bounds: &Bounds) -> f64 {
        let pixels = self.pixels(tile.level, bounds);
        self.want(tile, 2.0 * pixels);
        if pixels > 1.0 {
            for child in tile.children() {
                if self.coverage.has(child)
                    && let Some(common) = self.common(child, bounds)
                    && common.touches(&self.planes)
                {
                    self.visit(child, &common);
                }
            }
        }
        2.0 * pixels
    }

    /// Where both are, if anywhere.
    fn common(&self, tile: Tile, bounds: &Bounds) -> Option<Bounds> {
        let (corner, extent) = (self.texture.corner(tile), self.texture.extent(tile.level));
        let mut common = *bounds;
        common.min.x = common.min.x.max(corner[0]);
        common.min.y = common.min.y.max(corner[1]);
        common.max.x = common.max.x.min(corner[0] + extent[0]);
        common.max.y = common.max.y.min(corner[1] + extent[1]);
        (common.min.x <= common.max.x && common.min.y <= common.max.y).then_some(common)
    }

    fn want(&mut self, tile: Tile, need: f64) -> bool {
        let known = self.needs.entry(tile).or_insert(0.0);
        let is_more = need > *known;
        *known = known.max(need);
        is_more
    }

    /// Nothing is shown without its parents: they are needed more, as their own parents would be coarser still.
    fn need_parents(&mut self, tile: Tile, mut need: f64) {
        let mut next = tile.parent();
        while let Some(parent) = next {
            need *= 2.0;
            if !self.want(parent, need) {
                return;
            }
            next = parent.parent();
        }
    }
}
