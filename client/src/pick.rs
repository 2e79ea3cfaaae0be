//! What of the drawn terrain is under the cursor, and how high it stands.
//!
//! A ray is tried against the very triangles that are drawn, in `f64`: what is grabbed is what is seen. Of each diamond
//! whose box the ray passes in plan, only triangles with corners on both sides of the ray's vertical plane are
//! intersected; for a ray straight down, any vertical plane through it does.

use crate::drawing::DrawItem;
use crate::surface::Surface;
use crate::surface::triangles::{Form, Lists, lists, places};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::Layer;
use glam::{DVec2, DVec3};
use std::collections::HashMap;

/// A straight line from a point on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Where it begins, in the frame's metres, heights stretched.
    pub origin: DVec3,
    /// Where it goes, a unit vector.
    pub direction: DVec3,
}

/// Where a ray meets the ground first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// The place, in the frame's metres, heights stretched.
    pub point: DVec3,
    /// Metres from the ray's origin.
    pub distance: f64,
    /// Which layer.
    pub layer: usize,
    /// The diamond whose triangle it is.
    pub diamond: Diamond,
    /// The side of the diamond over which the triangle stands.
    pub side: usize,
}

/// Finds what rays meet. Keeps the index lists of forms of diamonds, which are the same every time.
#[derive(Debug, Default)]
pub struct Picker {
    forms: HashMap<Form, (Lists, Vec<[u16; 2]>)>,
}

/// The corners of an item relative to the ray's origin, and its triangles by side.
struct Mesh<'a> {
    corners: Vec<Option<DVec3>>,
    indices: &'a [u16],
    sides: &'a [std::ops::Range<u32>; 4],
}

impl Picker {
    /// The first place where a ray meets what is drawn. `items` as of a frame whose heights were multiplied by
    /// `exaggeration`.
    pub fn pick(
        &mut self,
        layers: &[Layer],
        items: &[DrawItem],
        exaggeration: f64,
        ray: &Ray,
    ) -> Option<Hit> {
        let flat = ray.direction.truncate();
        let across = flat.try_normalize().unwrap_or(DVec2::X).perp();
        let mut best: Option<Hit> = None;
        for item in items {
            let Some(layer) = layers.get(item.layer) else { continue };
            if !passes(layer, item.diamond, ray) {
                continue;
            }
            let mesh = self.mesh(layer, item, exaggeration, ray.origin);
            // On which side of the vertical plane of the ray.
            let asides: Vec<f64> = mesh
                .corners
                .iter()
                .map(|corner| corner.map_or(f64::NAN, |corner| across.dot(corner.truncate())))
                .collect();
            for (side, range) in mesh.sides.iter().enumerate().filter(|(side, _)| item.sides & 1 << side != 0)
            {
                for triangle in mesh.indices[range.start as usize..range.end as usize].chunks_exact(3) {
                    let slots = [0, 1, 2].map(|i| usize::from(triangle[i]));
                    let [a, b, c] = slots.map(|slot| asides[slot]);
                    // Without a height it compares with nothing, and is passed over.
                    let meets = (a <= 0.0 || b <= 0.0 || c <= 0.0) && (a >= 0.0 || b >= 0.0 || c >= 0.0);
                    let [Some(a), Some(b), Some(c)] = slots.map(|slot| mesh.corners[slot]) else { continue };
                    if !meets {
                        continue;
                    }
                    let nearest = best.as_ref().map_or(f64::INFINITY, |hit| hit.distance);
                    if let Some(distance) = crossing(ray.direction, [a, b, c]).filter(|d| *d < nearest) {
                        let point = ray.origin + ray.direction * distance;
                        best = Some(Hit { point, distance, layer: item.layer, diamond: item.diamond, side });
                    }
                }
            }
        }
        best
    }

    /// The height of what is drawn at a place, stretched; `None` where nothing is.
    pub fn ground(
        &mut self,
        layers: &[Layer],
        items: &[DrawItem],
        exaggeration: f64,
        place: DVec2,
    ) -> Option<f64> {
        let highest = layers.iter().map(|layer| layer.heights[1]).fold(f64::NEG_INFINITY, f64::max);
        let origin = place.extend(highest * exaggeration + 1e4);
        let ray = Ray { origin, direction: -DVec3::Z };
        Some(self.pick(layers, items, exaggeration, &ray)?.point.z)
    }

    fn mesh<'a>(
        &'a mut self,
        layer: &Layer,
        item: &'a DrawItem,
        exaggeration: f64,
        origin: DVec3,
    ) -> Mesh<'a> {
        let position = |lattice: [f64; 2], height: i32| {
            let [x, y] = [0, 1].map(|i| layer.origin[i] + layer.cell[i] * lattice[i]);
            DVec3::new(x, y, layer.metres(height) * exaggeration) - origin
        };
        match &*item.surface {
            Surface::Points(points) => {
                let block = points.block();
                let form = Form::of(block);
                let (lists, places) =
                    self.forms.entry(form).or_insert_with(|| (lists(form, |_| true), places(form)));
                let local = layer.forest.local(item.diamond);
                let corners = places.iter().zip(block.heights()).map(|([p, q], height)| {
                    let [p, q] = [p, q].map(|w| f64::from(*w) / 2.0);
                    let along =
                        |i: usize| local.origin[i] as f64 + local.u[i] as f64 * p + local.v[i] as f64 * q;
                    (*height != NODATA).then(|| position([along(0), along(1)], *height))
                });
                Mesh { corners: corners.collect(), indices: &lists.indices, sides: &lists.sides }
            }
            Surface::Tin(tin) => {
                let centre = item.diamond.centre();
                let corners = tin.corners().iter().map(|corner| {
                    let lattice = [0, 1].map(|i| f64::from(centre[i]) + f64::from(corner.place[i]));
                    Some(position(lattice, corner.height))
                });
                Mesh { corners: corners.collect(), indices: tin.indices(), sides: tin.sides() }
            }
        }
    }
}

/// Whether a ray passes over or under the square of a diamond.
fn passes(layer: &Layer, diamond: Diamond, ray: &Ray) -> bool {
    let [least, most] = layer.forest.bounds(diamond).map(|p| layer.position(p));
    let [low, high] = [0, 1].map(|i: usize| [least[i].min(most[i]), least[i].max(most[i])]);
    let (mut first, mut last) = (0.0f64, f64::INFINITY);
    for (axis, [low, high]) in [low, high].into_iter().enumerate() {
        let (from, by) = (ray.origin[axis], ray.direction[axis]);
        if by == 0.0 {
            if from < low || from > high {
                return false;
            }
        } else {
            let ends = [(low - from) / by, (high - from) / by];
            first = first.max(ends[0].min(ends[1]));
            last = last.min(ends[0].max(ends[1]));
        }
    }
    first <= last
}

/// The distance from the origin along a direction to a triangle, if it is met: after Möller and Trumbore, *Fast,
/// Minimum Storage Ray/Triangle Intersection* (1997), from either face.
fn crossing(direction: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let (ab, ac) = (b - a, c - a);
    let normal = direction.cross(ac);
    let volume = ab.dot(normal);
    if volume == 0.0 {
        return None;
    }
    let u = -a.dot(normal) / volume;
    let other = (-a).cross(ab);
    let v = direction.dot(other) / volume;
    let distance = ac.dot(other) / volume;
    // A hair more, so that no ray slips between two triangles.
    let slack = 1e-9;
    (u >= -slack && v >= -slack && u + v <= 1.0 + slack && distance > 0.0).then_some(distance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::controls::ray;
    use crate::encoding::Encoding;
    use crate::fetch;
    use crate::terrain::{Options, Terrain};
    use crate::world::{Dice, Faults, Served, above};
    use std::time::Duration;

    /// Up to where a ray meets the ground it runs above it, and there it is as high.
    #[test]
    fn a_ray_meets_the_first_ground_in_its_way() {
        for encoding in [Encoding::Points, Encoding::Tin] {
            let served = Served::start(1, Faults::default());
            let fetch = fetch::Options { encoding, ..fetch::Options::default() };
            let mut terrain = Terrain::open(&served.url, Options { fetch, ..Options::default() }).unwrap();
            let camera = above();
            let items = terrain.settle(&camera, Duration::from_secs(60)).items;
            let layers = &terrain.scene().layers;
            let range = layers[0].heights[1] - layers[0].heights[0];
            let (mut picker, mut dice, mut hits) = (Picker::default(), Dice(5), 0);
            for _ in 0..300 {
                let at = DVec2::new(dice.roll(), dice.roll()) * DVec2::from(camera.size.map(f64::from));
                let ray = Ray { origin: camera.eye, direction: ray(&camera, at) };
                let Some(hit) = picker.pick(layers, &items, 1.0, &ray) else { continue };
                hits += 1;
                let ground = picker.ground(layers, &items, 1.0, hit.point.truncate()).unwrap();
                assert!((ground - hit.point.z).abs() < 1e-6 * range, "{ground} {hit:?}");
                for part in 1..20 {
                    let p = ray.origin + ray.direction * (hit.distance * f64::from(part) / 20.0);
                    if let Some(ground) = picker.ground(layers, &items, 1.0, p.truncate()) {
                        assert!(p.z > ground - 1e-6 * range, "something nearer at {p}: {ground}, {hit:?}");
                    }
                }
            }
            assert!(hits > 50, "{hits}");
        }
    }
}
