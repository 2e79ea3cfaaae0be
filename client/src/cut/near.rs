//! Errors near the eye.
//!
//! The box of a diamond says little of one that the eye hovers over, or stands in: a hollow below a summit of the same
//! box is far away, and the box is not. What is drawn is known, so its cells or triangles tell how near any of it
//! comes, each by a box of its own. That takes some 0.1 ms a diamond (bench `cut/draw_hovering`), so it is asked of the worst few alone.

use super::Ask;
use crate::camera::Bounds;
use crate::surface::Surface;
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::{Block, Diamond};
use diamantina_protocol::message::Layer;
use glam::DVec3;

/// Diamonds of a layer that are looked at more closely in a frame.
const NEAR_MAX: usize = 8;

/// An error of a drawn diamond, as its box tells it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Near<'a> {
    pub(super) diamond: Diamond,
    pub(super) surface: &'a Surface,
    /// The level whose triangles have the error.
    pub(super) level: u32,
    pub(super) error_metres: f32,
    /// How far what is drawn may be from the surface, in metres.
    pub(super) lift_metres: f64,
    pub(super) pixels: f64,
}

/// Tells the worst of some errors more truly, if they are above the tolerance; calls back with the number of each that is
/// smaller than its box says.
pub(super) fn refine(ask: &Ask, errors: &[Near], mut smaller: impl FnMut(usize, f64)) {
    let above = |number: &usize| errors[*number].pixels > ask.tolerance_pixels;
    let mut order: Vec<usize> = (0..errors.len()).filter(above).collect();
    order.sort_unstable_by(|a, b| errors[*b].pixels.total_cmp(&errors[*a].pixels));
    let mut worst = 0.0f64;
    for number in order.into_iter().take(NEAR_MAX) {
        let error = &errors[number];
        // The others have no more.
        if error.pixels <= worst {
            break;
        }
        let pixels = error.looked_at(ask).min(error.pixels);
        worst = worst.max(pixels);
        smaller(number, pixels);
    }
}

impl Near<'_> {
    /// The largest apparent size of the error, in pixels, in any part of the surface that is in view.
    fn looked_at(&self, ask: &Ask) -> f64 {
        let planes = ask.camera.planes();
        let margin = DVec3::Z * (f64::from(self.error_metres) + self.lift_metres) * ask.exaggeration;
        let mut worst = 0.0f64;
        parts(ask.layer, self.diamond, self.surface, |part| {
            let part = part.stretched(ask.exaggeration);
            let part = Bounds { min: part.min - margin, max: part.max + margin };
            if part.touches(&planes) {
                worst = worst.max(ask.pixels(self.diamond, self.level, self.error_metres, &part));
            }
        });
        worst
    }
}

/// Calls back with boxes that hold the surface together: of its cells, or of its triangles.
fn parts(layer: &Layer, d: Diamond, surface: &Surface, mut part: impl FnMut(Bounds)) {
    let place = |lattice: [f64; 2]| [0, 1].map(|i| layer.origin[i] + layer.cell[i] * lattice[i]);
    let mut around = |corners: &[[f64; 2]], heights: [i32; 2]| {
        let least = corners.iter().fold([f64::INFINITY; 2], |a, b| [a[0].min(b[0]), a[1].min(b[1])]);
        let most = corners.iter().fold([f64::NEG_INFINITY; 2], |a, b| [a[0].max(b[0]), a[1].max(b[1])]);
        let [low, high] = heights.map(|height| layer.metres(height));
        part(Bounds { min: DVec3::new(least[0], least[1], low), max: DVec3::new(most[0], most[1], high) });
    };
    let range = |heights: &mut dyn Iterator<Item = i32>| {
        let heights = heights.filter(|height| *height != NODATA);
        heights.fold(None, |range: Option<[i32; 2]>, height| {
            Some(range.map_or([height; 2], |[low, high]| [low.min(height), high.max(height)]))
        })
    };
    match surface {
        Surface::Points(points) => {
            let (block, local) = (points.block(), layer.forest.local(d));
            let n = block.segments();
            let [origin, along, across] = [local.origin, local.u, local.v].map(|w| w.map(|i| i as f64));
            for (v, u) in (0..n).flat_map(|v| (0..n).map(move |u| (v, u))) {
                let corners = [[0, 0], [1, 0], [0, 1], [1, 1]];
                let slots = corners.map(|[du, dv]| Block::slot(n, 2 * (u + du), 2 * (v + dv)));
                let centre = block.has_centres().then(|| Block::slot(n, 2 * u + 1, 2 * v + 1));
                let mut heights = slots.into_iter().chain(centre).map(|slot| block.heights()[slot]);
                let Some(heights) = range(&mut heights) else { continue };
                let corners = corners.map(|[du, dv]| {
                    let (u, v) = ((u + du) as f64, (v + dv) as f64);
                    place([0, 1].map(|i| origin[i] + along[i] * u + across[i] * v))
                });
                around(&corners, heights);
            }
        }
        Surface::Tin(tin) => {
            let centre = d.centre().map(f64::from);
            for triangle in tin.indices().chunks_exact(3) {
                let corners = [0, 1, 2].map(|i| tin.corners()[usize::from(triangle[i])]);
                let Some(heights) = range(&mut corners.iter().map(|corner| corner.height)) else { continue };
                let corners = corners.map(|c| place([0, 1].map(|i| centre[i] + f64::from(c.place[i]))));
                around(&corners, heights);
            }
        }
    }
}
