//! Surfaces on the GPU, under a budget of bytes.
//!
//! A grid takes 8 bytes a point (66 kB for n = 64), if it has nodata, its own index lists (up to 98 kB), and, as
//! long as it moves, 20 bytes a point (166 kB). Irregular triangles take 16 bytes a vertex and 6 a triangle. The lines
//! around triangles, once they are drawn, take twice as much as their index lists. Those that the present frame draws always stay
//! (the cut sees to it that they fit); of the others, the longest unseen go first, before new ones come.

use crate::camera::Bounds;
use crate::drawing::DrawItem;
use crate::morph::Motion;
use crate::surface::rim::{Rim, rim};
use crate::surface::triangles::{self, Form, Lists};
use crate::surface::{Points, Surface, Tin};
use diamantina_protocol::NODATA;
use diamantina_protocol::diamond::Diamond;
use diamantina_protocol::message::{Kind, Layer};
use glam::DVec3;
use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Weak};
use wgpu::util::DeviceExt;

/// A point of a surface: height in quanta, and the normal's east and north as snorm16.
#[repr(C)]
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub(super) struct SurfacePoint {
    height: i32,
    normal: [i16; 2],
}

/// What all diamonds of a form share.
pub(super) struct Grid {
    /// Doubled local coordinates of each slot.
    pub(super) places: wgpu::Buffer,
    /// The index lists of the four sides.
    pub(super) triangles: Triangles,
}

/// Index lists on the GPU.
pub(super) struct Triangles {
    /// 16-bit indices.
    pub(super) indices: wgpu::Buffer,
    /// Where each side's list lies.
    pub(super) sides: [Range<u32>; 4],
    /// Where the lists of the ring around them lie, of water.
    pub(super) ring: [Range<u32>; 4],
    /// The lines around the triangles, if they are wanted: for each index two, from its vertex to the next one's.
    pub(super) lines: Option<wgpu::Buffer>,
}

/// A surface on the GPU.
pub(super) struct Resident {
    /// Which surface it is: the weak pointer keeps the address from being used again.
    surface: Weak<Surface>,
    /// A [`SurfacePoint`] a slot; of irregular triangles the [`crate::surface::Corner`]s.
    pub(super) points: wgpu::Buffer,
    /// Its own index lists, if it has nodata or irregular triangles.
    pub(super) own: Option<Triangles>,
    /// The motion of its points in the last frame that drew it.
    pub(super) motion: Option<MotionBuffer>,
    /// The box around all its points where they stand still; `None` if nothing is there to draw.
    bounds: Option<Bounds>,
    bytes: u64,
    last_frame: u64,
}

/// The motion of a surface on the GPU.
pub(super) struct MotionBuffer {
    /// Which motion it is, as with surfaces.
    motion: Weak<Motion>,
    /// A [`crate::morph::Record`] a slot.
    pub(super) records: wgpu::Buffer,
    span: f32,
}

type Key = (usize, Diamond);

/// All surfaces on the GPU.
pub(super) struct Residents {
    bytes: u64,
    frame: u64,
    by_key: HashMap<Key, Resident>,
    by_form: HashMap<Form, Grid>,
}

impl Residents {
    pub(super) fn new() -> Self {
        Self { bytes: 0, frame: 0, by_key: HashMap::new(), by_form: HashMap::new() }
    }

    /// Bytes of GPU memory that surfaces take.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes of GPU memory that all diamonds of a form share.
    pub(super) fn shared_bytes(&self) -> u64 {
        self.by_form.values().map(|grid| grid.places.size() + grid.triangles.bytes()).sum()
    }

    pub(super) fn get(&self, item: &DrawItem) -> Option<&Resident> {
        self.by_key.get(&(item.layer, item.diamond))
    }

    /// What an item shares with others of its form: nothing where its triangles are irregular.
    pub(super) fn grid(&self, item: &DrawItem) -> Option<&Grid> {
        self.by_form.get(&Form::of(item.surface.points()?.block()))
    }

    /// Starts a frame that draws these items, and these at rest in mirrors: uploads those that are not there yet, and drops others
    /// where all would take more than `room_bytes`. Returns the bytes uploaded. Items of unknown layers are passed over.
    pub(super) fn start_frame<'a>(
        &mut self,
        device: &wgpu::Device,
        layers: &[Layer],
        items: &'a [DrawItem],
        mirrored: impl Iterator<Item = &'a DrawItem> + Clone,
        wires: bool,
        room_bytes: u64,
    ) -> u64 {
        self.frame += 1;
        let mut coming_bytes = 0;
        let all = items.iter().map(|item| (item, true)).chain(mirrored.map(|item| (item, false)));
        for (item, moves) in all.clone() {
            match self.by_key.get_mut(&(item.layer, item.diamond)) {
                Some(resident) => {
                    resident.last_frame = self.frame;
                    if moves && !resident.moves_as(item) {
                        coming_bytes += item.motion_bytes();
                    }
                }
                None => coming_bytes += item.gpu_bytes(wires),
            }
        }
        self.shrink(room_bytes.saturating_sub(coming_bytes));
        let mut uploaded_bytes = 0;
        for (item, moves) in all {
            let Some(layer) = layers.get(item.layer) else { continue };
            if let Some(points) = item.surface.points() {
                let form = Form::of(points.block());
                if form.segments != layer.forest.segments_at(item.diamond.level()) {
                    continue;
                }
                let grid = self.by_form.entry(form).or_insert_with(|| Grid::new(device, form, wires));
                if wires && grid.triangles.lines.is_none() {
                    *grid = Grid::new(device, form, wires);
                }
            }
            let key = (item.layer, item.diamond);
            let lacks_lines = |own: &Triangles| wires && own.lines.is_none();
            if let Some(resident) = self.by_key.get_mut(&key)
                && std::ptr::eq(resident.surface.as_ptr(), Arc::as_ptr(&item.surface))
                && !resident.own.as_ref().is_some_and(lacks_lines)
            {
                resident.last_frame = self.frame;
                let old_bytes = resident.bytes;
                if moves {
                    uploaded_bytes += resident.move_as(device, item);
                }
                self.bytes = self.bytes + resident.bytes - old_bytes;
                continue;
            }
            let mut resident = Resident::upload(device, layer, item, self.frame, wires);
            resident.move_as(device, item);
            uploaded_bytes += resident.bytes;
            self.bytes += resident.bytes;
            if let Some(old) = self.by_key.insert(key, resident) {
                self.bytes -= old.bytes;
            }
        }
        self.shrink(room_bytes);
        uploaded_bytes
    }

    /// Drops what this frame does not draw, longest unseen first, until the rest takes no more than that.
    fn shrink(&mut self, bytes_max: u64) {
        if self.bytes <= bytes_max {
            return;
        }
        let idle = self.by_key.iter().filter(|(_, r)| r.last_frame < self.frame);
        let mut idle: Vec<(u64, Key)> = idle.map(|(key, r)| (r.last_frame, *key)).collect();
        idle.sort_unstable();
        for (_, key) in idle {
            if self.bytes <= bytes_max {
                break;
            }
            if let Some(old) = self.by_key.remove(&key) {
                self.bytes -= old.bytes;
            }
        }
    }
}

impl Grid {
    fn new(device: &wgpu::Device, form: Form, wires: bool) -> Self {
        let places = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("places"),
            contents: bytemuck::cast_slice(&triangles::places(form)),
            usage: wgpu::BufferUsages::VERTEX,
        });
        Self { places, triangles: Triangles::new(device, triangles::lists(form, |_| true), wires) }
    }
}

impl Triangles {
    fn new(device: &wgpu::Device, lists: Lists, wires: bool) -> Self {
        let mut indices = lists.indices;
        let lines = wires.then(|| {
            let around = |t: &[u16]| [t[0], t[1], t[1], t[2], t[2], t[0]];
            let lines: Vec<u16> = indices.chunks_exact(3).flat_map(around).collect();
            device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
                label: Some("lines"),
                contents: bytemuck::cast_slice(&lines),
                usage: wgpu::BufferUsages::INDEX,
            })
        });
        // Buffers are whole numbers of 4 bytes.
        indices.resize(indices.len().next_multiple_of(2), 0);
        let indices = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("triangles"),
            contents: bytemuck::cast_slice(&indices),
            usage: wgpu::BufferUsages::INDEX,
        });
        Self { indices, sides: lists.sides, ring: [const { 0..0 }; 4], lines }
    }

    /// Those of water, and of the ring around it.
    fn ringed(device: &wgpu::Device, mut lists: Lists, ring: Lists, wires: bool) -> Self {
        let first = u32::try_from(lists.indices.len()).unwrap_or(0);
        lists.indices.extend(ring.indices);
        let ring = ring.sides.map(|side| first + side.start..first + side.end);
        Self { ring, ..Self::new(device, lists, wires) }
    }

    /// Bytes of GPU memory that they take.
    fn bytes(&self) -> u64 {
        self.indices.size() + self.lines.as_ref().map_or(0, wgpu::Buffer::size)
    }
}

impl Resident {
    fn upload(device: &wgpu::Device, layer: &Layer, item: &DrawItem, frame: u64, wires: bool) -> Self {
        let (points, own, range) = match &*item.surface {
            Surface::Points(points) if layer.kind == Kind::Water && points.has_nodata() => {
                upload_water(device, layer, item.diamond, points, wires)
            }
            Surface::Points(points) => upload_points(device, points, wires),
            Surface::Tin(tin) => upload_tin(device, tin, wires),
        };
        let bytes = points.size() + own.as_ref().map_or(0, Triangles::bytes);
        // Lone points make no triangles, and an empty buffer cannot be drawn from.
        let is_empty = own.as_ref().is_some_and(|t| t.indices.size() == 0);
        let bounds = range.filter(|_| !is_empty).map(|range| bounds(layer, item.diamond, range));
        let surface = Arc::downgrade(&item.surface);
        Self { surface, points, own, motion: None, bounds, bytes, last_frame: frame }
    }

    /// Whether it has the motion of the item and no other.
    fn moves_as(&self, item: &DrawItem) -> bool {
        let wanted = item.moving.as_ref().map(|moving| Arc::as_ptr(&moving.motion));
        self.motion.as_ref().map(|buffer| buffer.motion.as_ptr()) == wanted
    }

    /// Has the motion of the item and no other. Returns the bytes uploaded.
    fn move_as(&mut self, device: &wgpu::Device, item: &DrawItem) -> u64 {
        if self.moves_as(item) {
            return 0;
        }
        let wanted = item.moving.as_ref().map(|moving| &moving.motion);
        self.bytes -= self.motion.take().map_or(0, |old| old.records.size());
        let slots = item.surface.points().map(|points| points.normals().len());
        let Some(motion) = wanted.filter(|m| slots == Some(m.records().len())) else {
            return 0;
        };
        let records = device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
            label: Some("motion"),
            contents: bytemuck::cast_slice(motion.records()),
            usage: wgpu::BufferUsages::VERTEX,
        });
        let bytes = records.size();
        self.bytes += bytes;
        self.motion = Some(MotionBuffer { motion: Arc::downgrade(motion), records, span: motion.span() });
        bytes
    }

    /// The box around all its points, wherever they are on their way; `None` if nothing is there to draw.
    /// `quantum` in metres.
    pub(super) fn bounds(&self, quantum: f64) -> Option<Bounds> {
        let span = self.motion.as_ref().map_or(0.0, |motion| f64::from(motion.span) * quantum);
        self.bounds.map(|b| Bounds { min: b.min - DVec3::Z * span, max: b.max + DVec3::Z * span })
    }
}

/// A point as the GPU has it. One without height gets 0: no triangle uses it.
fn point(height: i32, normal: [i16; 2]) -> SurfacePoint {
    SurfacePoint { height: if height == NODATA { 0 } else { height }, normal }
}

/// Vertices, their own index lists, and the lowest and highest of their heights.
type Uploaded = (wgpu::Buffer, Option<Triangles>, Option<[i32; 2]>);

fn upload_points(device: &wgpu::Device, points: &Points, wires: bool) -> Uploaded {
    let heights = points.block().heights();
    let all: Vec<SurfacePoint> =
        heights.iter().zip(points.normals()).map(|(h, normal)| point(*h, *normal)).collect();
    let own = points.has_nodata().then(|| Triangles::new(device, triangles::lists_of(points.block()), wires));
    let range = range(heights.iter().copied().filter(|h| *h != NODATA));
    (vertices(device, bytemuck::cast_slice(&all)), own, range)
}

/// Water that is not everywhere: it has a ring around it that runs on under the ground, as far as there are samples.
fn upload_water(
    device: &wgpu::Device,
    layer: &Layer,
    diamond: Diamond,
    points: &Points,
    wires: bool,
) -> Uploaded {
    let (block, local) = (points.block(), layer.forest.local(diamond));
    let is_within = |[p, q]: [u16; 2]| {
        (0..2).all(|i| {
            let at = local.origin[i] + (local.u[i] * i64::from(p) + local.v[i] * i64::from(q)) / 2;
            (0..i64::from(layer.samples[i])).contains(&at)
        })
    };
    let Rim { heights, lists } = rim(block, is_within);
    let all: Vec<SurfacePoint> =
        heights.iter().zip(points.normals()).map(|(h, normal)| point(*h, *normal)).collect();
    let own = Triangles::ringed(device, triangles::lists_of(block), lists, wires);
    let range = range(heights.iter().copied().filter(|h| *h != NODATA));
    (vertices(device, bytemuck::cast_slice(&all)), Some(own), range)
}

fn upload_tin(device: &wgpu::Device, tin: &Tin, wires: bool) -> Uploaded {
    let lists = Lists { indices: tin.indices().to_vec(), sides: tin.sides().clone() };
    let range = range(tin.corners().iter().map(|corner| corner.height));
    let own = Triangles::new(device, lists, wires);
    (vertices(device, bytemuck::cast_slice(tin.corners())), Some(own), range)
}

fn vertices(device: &wgpu::Device, contents: &[u8]) -> wgpu::Buffer {
    device.create_buffer_init(&wgpu::util::BufferInitDescriptor {
        label: Some("surface"),
        contents,
        usage: wgpu::BufferUsages::VERTEX,
    })
}

fn range(heights: impl Iterator<Item = i32> + Clone) -> Option<[i32; 2]> {
    Some([heights.clone().min()?, heights.max()?])
}

/// The box around a diamond's points of these heights.
fn bounds(layer: &Layer, diamond: Diamond, heights: [i32; 2]) -> Bounds {
    let [lowest, highest] = heights.map(|h| layer.metres(h));
    let [south_west, north_east] = layer.forest.bounds(diamond).map(|p| layer.position(p));
    Bounds {
        min: DVec3::new(south_west[0], south_west[1], lowest),
        max: DVec3::new(north_east[0], north_east[1], highest),
    }
}
