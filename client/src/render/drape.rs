//! Imagery on the GPU: the pictures of tiles, in sheets, and the quadtree that leads a pixel to them.
//!
//! All pictures lie in one array of textures, [`ACROSS`] by [`ACROSS`] in each, or in one of fewer rows. A second small texture holds the quadtree:
//! see `shaders/drape.wgsl`, which goes down it for each pixel. So what is drawn and how fine its imagery is have nothing
//! to do with each other, and a diamond of any size may show tiles of any level.

use super::frame::single;
use super::view::View;
use crate::camera::Bounds;
use crate::texture::{self, Coding, Drape, TileImage, plain, within};
use diamantina_protocol::texture::{SIDE, Texture, Tile};
use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, Weak};

/// Pictures along each side of a whole sheet. A twin of `ACROSS` in the shader, and of [`texture::ROW`].
const ACROSS: u32 = 8;

const _: () = assert!(texture::ROW == ACROSS as usize && texture::SHEET_ROWS == ACROSS as usize);

/// Pictures in a sheet.
const IN_SHEET: u32 = ACROSS * ACROSS;

/// The quadtree's texture has so many places along each side. A twin of a number in the shader.
const NODES_SIDE: u32 = 64;

/// How much coarser than what any of its pixels shows a diamond's first tile is, in levels: what is seen at a slant is
/// reached by going up, which the shader does not.
const HEADROOM: i32 = 3;

/// What a tile's place in the quadtree tells: see the shader.
type Node = [u32; 4];

/// What is to be told of a diamond: the first tile, and where in it a place relative to the eye lies.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Start {
    /// 0: no imagery.
    pub(super) node: u32,
    /// East and north, from 0 to 1 in the tile: offset, and factor of metres from the eye.
    pub(super) place: [f32; 4],
}

/// Imagery on the GPU.
pub(super) struct Drapes {
    layout: wgpu::BindGroupLayout,
    sampler: wgpu::Sampler,
    nodes: wgpu::Texture,
    /// Made when there is imagery to show; before, a sheet of nothing.
    sheets: wgpu::Texture,
    /// How texels lie in the sheets.
    coding: Coding,
    capacity: usize,
    group: wgpu::BindGroup,
    /// The pictures that are there, with their place.
    places: HashMap<Tile, (u32, Weak<TileImage>)>,
    free: Vec<u32>,
    texture: Option<Arc<Texture>>,
    /// The number in the quadtree of each tile shown.
    numbers: HashMap<Tile, u32>,
    told: Vec<Node>,
    /// What the sheets take.
    bytes: u64,
}

/// Bytes of the quadtree's texture.
const NODES_BYTES: u64 = 16 * (NODES_SIDE * NODES_SIDE) as u64;

impl Drapes {
    /// `anisotropy`: how many steps the sampler takes along the longer side of what a pixel shows.
    pub(super) fn new(device: &wgpu::Device, anisotropy: u16) -> Self {
        let entry = |binding, ty| wgpu::BindGroupLayoutEntry {
            binding,
            visibility: wgpu::ShaderStages::FRAGMENT,
            ty,
            count: None,
        };
        let texture = |sample_type, view_dimension| wgpu::BindingType::Texture {
            sample_type,
            view_dimension,
            multisampled: false,
        };
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some("imagery"),
            entries: &[
                entry(0, texture(wgpu::TextureSampleType::Uint, wgpu::TextureViewDimension::D2)),
                entry(
                    1,
                    texture(
                        wgpu::TextureSampleType::Float { filterable: true },
                        wgpu::TextureViewDimension::D2Array,
                    ),
                ),
                entry(2, wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering)),
            ],
        });
        let sampler = device.create_sampler(&wgpu::SamplerDescriptor {
            label: Some("imagery"),
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            mipmap_filter: wgpu::MipmapFilterMode::Linear,
            anisotropy_clamp: anisotropy.clamp(1, 16),
            ..Default::default()
        });
        let nodes = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("quadtree of imagery"),
            size: wgpu::Extent3d { width: NODES_SIDE, height: NODES_SIDE, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: wgpu::TextureFormat::Rgba32Uint,
            usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
            view_formats: &[],
        });
        let sheets = sheets(device, Coding::Plain, [1, 1], 1);
        let group = group(device, &layout, &nodes, &sheets, &sampler);
        Self {
            layout,
            sampler,
            nodes,
            sheets,
            coding: Coding::Plain,
            capacity: 0,
            group,
            places: HashMap::new(),
            free: Vec::new(),
            texture: None,
            numbers: HashMap::new(),
            told: Vec::new(),
            bytes: 0,
        }
    }

    pub(super) fn layout(&self) -> &wgpu::BindGroupLayout {
        &self.layout
    }

    pub(super) fn group(&self) -> &wgpu::BindGroup {
        &self.group
    }

    /// Bytes of GPU memory that it takes, pictures included.
    pub(super) fn bytes(&self) -> u64 {
        NODES_BYTES + self.bytes
    }

    /// Bytes of GPU memory that the pictures take.
    pub(super) fn pictures_bytes(&self) -> u64 {
        self.bytes
    }

    /// Bytes that it takes before there is a picture.
    pub(super) fn least_bytes() -> u64 {
        NODES_BYTES
    }

    /// Shows this imagery from now on, or none. Returns the bytes uploaded.
    pub(super) fn show(&mut self, device: &wgpu::Device, queue: &wgpu::Queue, drape: Option<&Drape>) -> u64 {
        self.texture = drape.map(|drape| Arc::clone(&drape.texture));
        self.numbers.clear();
        let Some(drape) = drape else {
            if self.capacity > 0 {
                self.make_room(device, 0, Coding::Plain);
            }
            return 0;
        };
        let coding = if reads_blocks(device) { drape.coding } else { Coding::Plain };
        if drape.capacity != self.capacity || coding != self.coding {
            self.make_room(device, drape.capacity, coding);
        }
        let (free, places) = (&mut self.free, &mut self.places);
        let images: HashMap<Tile, &Arc<TileImage>> =
            drape.tiles.iter().map(|draped| (draped.tile, &draped.image)).collect();
        places.retain(|tile, (place, here)| {
            let stays = images.get(tile).is_some_and(|image| std::ptr::eq(here.as_ptr(), Arc::as_ptr(image)));
            if !stays {
                free.push(*place);
            }
            stays
        });
        let mut uploaded = 0;
        let mut nodes: Vec<Node> = vec![[0; 4]];
        for draped in &drape.tiles {
            let place = match self.places.get(&draped.tile) {
                Some((place, _)) => *place,
                // No frame shows more than the capacity.
                None => {
                    let Some(place) = self.free.pop() else { continue };
                    upload(queue, &self.sheets, coding, place, &draped.image);
                    uploaded += coding.tile_bytes() as u64;
                    self.places.insert(draped.tile, (place, Arc::downgrade(&draped.image)));
                    place
                }
            };
            let number = nodes.len();
            if let Some(parent) = draped.tile.parent().and_then(|parent| self.numbers.get(&parent)) {
                let quarter = draped.tile.quarter();
                let shift = 16 * (quarter % 2);
                #[allow(clippy::cast_possible_truncation, reason = "fewer than 2^12")]
                let bits = (number as u32) << shift;
                nodes[*parent as usize][2 + quarter / 2] |= bits;
            } else if draped.tile.level > 0 {
                continue;
            }
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "from 0 to 255")]
            let weight = (draped.weight.clamp(0.0, 1.0) * 255.0).round() as u32;
            nodes.push([place, weight, 0, 0]);
            #[allow(clippy::cast_possible_truncation, reason = "fewer than 2^12")]
            self.numbers.insert(draped.tile, number as u32);
        }
        if nodes != self.told {
            self.tell(queue, &nodes);
            self.told = nodes;
        }
        uploaded
    }

    /// Makes room for so many pictures, or for none. Those that were there have to come again.
    fn make_room(&mut self, device: &wgpu::Device, capacity: usize, coding: Coding) {
        let [rows, count] = texture::sheets(capacity).map(|n| u32::try_from(n).unwrap_or(u32::MAX));
        let count = count.min(device.limits().max_texture_array_layers);
        let size = if capacity == 0 { [1, 1] } else { [ACROSS * SIDE, rows * SIDE] };
        // The old ones go before the new ones come.
        self.sheets.destroy();
        self.sheets = sheets(device, coding, size, count);
        self.group = group(device, &self.layout, &self.nodes, &self.sheets, &self.sampler);
        (self.capacity, self.coding) = (capacity, coding);
        self.places.clear();
        let places = if capacity == 0 { 0 } else { count * rows * ACROSS };
        self.free = (0..places).rev().collect();
        self.bytes = u64::from(places) * coding.tile_bytes() as u64;
    }

    fn tell(&self, queue: &wgpu::Queue, nodes: &[Node]) {
        let rows = u32::try_from(nodes.len()).unwrap_or(0).div_ceil(NODES_SIDE).min(NODES_SIDE);
        let mut all = vec![[0u32; 4]; (rows * NODES_SIDE) as usize];
        let count = nodes.len().min(all.len());
        all[..count].copy_from_slice(&nodes[..count]);
        queue.write_texture(
            self.nodes.as_image_copy(),
            bytemuck::cast_slice(&all),
            wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(16 * NODES_SIDE),
                rows_per_image: None,
            },
            wgpu::Extent3d { width: NODES_SIDE, height: rows, depth_or_array_layers: 1 },
        );
    }

    /// Where a diamond's imagery begins that is drawn in a box.
    pub(super) fn start(&self, bounds: &Bounds, view: &View) -> Start {
        let Some(texture) = &self.texture else { return Start::default() };
        let [min, max] = [bounds.min, bounds.max].map(|corner| [corner.x, corner.y]);
        let Some(mut tile) = within(texture, min, max) else { return Start::default() };
        // So coarse that no pixel of it wants a coarser one, and that its own parent's share is known.
        let eye = view.eye();
        let farthest = (bounds.min - eye).abs().max((bounds.max - eye).abs()).length();
        let [x, y] = texture.texel_at(0);
        let coarsest = x.max(y) * view.pixels_per_radian() / farthest.max(1e-9);
        #[allow(clippy::cast_possible_truncation, reason = "a few levels")]
        let wanted = coarsest.log2().floor().clamp(-100.0, 100.0) as i32 - HEADROOM;
        let mut is_there = false;
        while let Some(parent) = tile.parent() {
            if is_there && i64::from(tile.level) <= i64::from(wanted.max(0)) {
                break;
            }
            is_there |= self.numbers.contains_key(&tile);
            tile = parent;
        }
        let Some(node) = self.numbers.get(&tile) else { return Start::default() };
        let (corner, extent) = (texture.corner(tile), texture.extent(tile.level));
        let offset = [0, 1].map(|i| single((eye[i] - corner[i]) / extent[i]));
        let factor = extent.map(|metres| single(1.0 / metres));
        Start { node: *node, place: [offset[0], offset[1], factor[0], factor[1]] }
    }
}

/// Whether a device takes texels in blocks as they are.
pub(super) fn reads_blocks(device: &wgpu::Device) -> bool {
    device.features().contains(wgpu::Features::TEXTURE_COMPRESSION_BC)
}

fn sheets(device: &wgpu::Device, coding: Coding, [width, height]: [u32; 2], count: u32) -> wgpu::Texture {
    device.create_texture(&wgpu::TextureDescriptor {
        label: Some("imagery"),
        size: wgpu::Extent3d { width, height, depth_or_array_layers: count },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format: match coding {
            Coding::Plain => wgpu::TextureFormat::Rgba8UnormSrgb,
            Coding::Blocks => wgpu::TextureFormat::Bc7RgbaUnormSrgb,
        },
        usage: wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST,
        view_formats: &[],
    })
}

fn group(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    nodes: &wgpu::Texture,
    sheets: &wgpu::Texture,
    sampler: &wgpu::Sampler,
) -> wgpu::BindGroup {
    let nodes = nodes.create_view(&wgpu::TextureViewDescriptor::default());
    let sheets = sheets.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        ..Default::default()
    });
    device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some("imagery"),
        layout,
        entries: &[
            wgpu::BindGroupEntry { binding: 0, resource: wgpu::BindingResource::TextureView(&nodes) },
            wgpu::BindGroupEntry { binding: 1, resource: wgpu::BindingResource::TextureView(&sheets) },
            wgpu::BindGroupEntry { binding: 2, resource: wgpu::BindingResource::Sampler(sampler) },
        ],
    })
}

fn upload(queue: &wgpu::Queue, sheets: &wgpu::Texture, coding: Coding, place: u32, image: &TileImage) {
    let cell = place % IN_SHEET;
    let origin = wgpu::Origin3d { x: cell % ACROSS * SIDE, y: cell / ACROSS * SIDE, z: place / IN_SHEET };
    let texels = match (image.coding(), coding) {
        (Coding::Blocks, Coding::Plain) => Cow::Owned(plain(image.texels())),
        _ => Cow::Borrowed(image.texels()),
    };
    queue.write_texture(
        wgpu::TexelCopyTextureInfo { origin, ..sheets.as_image_copy() },
        &texels,
        // Of blocks, too: 16 bytes for four texels of a row, and a row of them is four texels high.
        wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(4 * SIDE), rows_per_image: None },
        wgpu::Extent3d { width: SIDE, height: SIDE, depth_or_array_layers: 1 },
    );
}
