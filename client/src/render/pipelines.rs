//! Pipelines: how vertices of each kind become pixels of each pass.

use super::DEPTH;
use super::lens::Instance;
use super::resident::SurfacePoint;
use crate::morph::Record;
use crate::surface::Corner;

/// The shaders of terrain: what becomes of heights, and what colour that has.
pub(super) const TERRAIN_WGSL: &str = concat!(
    include_str!("../../../shaders/frame.wgsl"),
    include_str!("../../../shaders/surface.wgsl"),
    include_str!("../../../shaders/drape.wgsl"),
    include_str!("../../../shaders/terrain.wgsl")
);
/// The shaders of water: its surface is one like that of terrain.
pub(super) const WATER_WGSL: &str = concat!(
    include_str!("../../../shaders/frame.wgsl"),
    include_str!("../../../shaders/surface.wgsl"),
    include_str!("../../../shaders/water.wgsl")
);
/// The shaders of the sky.
pub(super) const SKY_WGSL: &str =
    concat!(include_str!("../../../shaders/frame.wgsl"), include_str!("../../../shaders/sky.wgsl"));

/// What a diamond's vertices are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Kind {
    Points,
    MovingPoints,
    Corners,
    /// In some of the pixels.
    FadingCorners,
}

impl Kind {
    /// The places of the buffers of a diamond's instance and its vertices.
    pub(super) fn buffers(self) -> [u32; 2] {
        match self {
            Self::Points | Self::MovingPoints => [2, 1],
            Self::Corners | Self::FadingCorners => [1, 0],
        }
    }
}

/// How triangles are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mode {
    Filled,
    /// A little farther away than they are, so that lines along their sides are seen.
    Behind,
    Lines,
    /// Only what is above the mirror.
    Mirrored,
    /// As water, which takes a third group.
    Water,
}

/// What a pass draws to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Target {
    pub(super) format: wgpu::TextureFormat,
    /// Samples a pixel.
    pub(super) samples: u32,
}

/// A pipeline for each kind.
pub(super) type Pipelines = [wgpu::RenderPipeline; 4];

/// What the vertex shaders take of each buffer: see `shaders/terrain.wgsl`.
const PLACE: &[wgpu::VertexAttribute] = &wgpu::vertex_attr_array![0 => Uint16x2];
const POINT: &[wgpu::VertexAttribute] = &wgpu::vertex_attr_array![1 => Sint32, 2 => Snorm16x2];
const INSTANCE: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![3 => Sint32x2, 4 => Sint32x4, 5 => Sint32x4, 10 => Float32x4, 11 => Float32];
pub(super) const RECORD: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![6 => Float32x2, 7 => Snorm16x2, 8 => Snorm16x2, 9 => Sint32];

const CORNER: &[wgpu::VertexAttribute] =
    &wgpu::vertex_attr_array![0 => Sint32x2, 1 => Sint32, 2 => Snorm16x2];

/// The pipelines of points that stand still and that move, and of irregular triangles in all pixels and in some: in the order of
/// [`Kind`].
pub(super) fn terrain_pipelines(
    device: &wgpu::Device,
    target: Target,
    groups: &[&wgpu::BindGroupLayout],
    mode: Mode,
) -> Pipelines {
    let layout = |stride: usize, step_mode, attributes| {
        Some(wgpu::VertexBufferLayout { array_stride: stride as u64, step_mode, attributes })
    };
    let (vertex, instance) = (wgpu::VertexStepMode::Vertex, wgpu::VertexStepMode::Instance);
    let points = [
        layout(4, vertex, PLACE),
        layout(size_of::<SurfacePoint>(), vertex, POINT),
        layout(size_of::<Instance>(), instance, INSTANCE),
        layout(size_of::<Record>(), vertex, RECORD),
    ];
    let corners =
        [layout(size_of::<Corner>(), vertex, CORNER), layout(size_of::<Instance>(), instance, INSTANCE)];
    let (source, fragment) = match mode {
        Mode::Filled | Mode::Behind => (TERRAIN_WGSL, "terrain_fragment"),
        Mode::Lines => (TERRAIN_WGSL, "wire_fragment"),
        Mode::Mirrored => (TERRAIN_WGSL, "mirrored_fragment"),
        Mode::Water => (WATER_WGSL, "water_fragment"),
    };
    let stage = Stage::new(device, source, groups);
    // Both faces are drawn: terrain seen from below is terrain still.
    let made = |kind, vertex, buffers: &[_]| {
        let compare = match mode {
            Mode::Lines => wgpu::CompareFunction::GreaterEqual,
            _ => wgpu::CompareFunction::Greater,
        };
        let depth = Depth { compare, write: true, behind: mode == Mode::Behind };
        let topology = match mode {
            Mode::Lines => wgpu::PrimitiveTopology::LineList,
            _ => wgpu::PrimitiveTopology::TriangleList,
        };
        // Where a shader leaves out pixels, the GPU cannot tell beforehand which ones are hidden: so only where need be.
        let constants = [("IN_SOME_PIXELS", 1.0)];
        let constants = if kind == Kind::FadingCorners { &constants[..] } else { &[] };
        let blend = (mode == Mode::Lines).then_some(wgpu::BlendState::ALPHA_BLENDING);
        stage.pipeline(device, target, [vertex, fragment], constants, buffers, depth, topology, blend)
    };
    [
        made(Kind::Points, "terrain_vertex", &points[..3]),
        made(Kind::MovingPoints, "terrain_morph_vertex", &points),
        made(Kind::Corners, "tin_vertex", &corners),
        made(Kind::FadingCorners, "tin_vertex", &corners),
    ]
}

/// What a pipeline does with depth.
#[derive(Debug, Clone, Copy)]
struct Depth {
    compare: wgpu::CompareFunction,
    write: bool,
    /// Whether to move triangles away by a few steps of depth, and more where they are steep.
    behind: bool,
}

pub(super) fn sky_pipeline(
    device: &wgpu::Device,
    target: Target,
    frame: &wgpu::BindGroupLayout,
) -> wgpu::RenderPipeline {
    // Infinitely far, so equal to the cleared depth and behind all else.
    let entries = ["sky_vertex", "sky_fragment"];
    let depth = Depth { compare: wgpu::CompareFunction::GreaterEqual, write: false, behind: false };
    let topology = wgpu::PrimitiveTopology::TriangleList;
    Stage::new(device, SKY_WGSL, &[frame]).pipeline(device, target, entries, &[], &[], depth, topology, None)
}

/// What pipelines of the same shaders share: they are read and checked once.
struct Stage {
    module: wgpu::ShaderModule,
    layout: wgpu::PipelineLayout,
}

impl Stage {
    fn new(device: &wgpu::Device, source: &str, groups: &[&wgpu::BindGroupLayout]) -> Self {
        let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: None,
            source: wgpu::ShaderSource::Wgsl(source.into()),
        });
        let groups: Vec<_> = groups.iter().map(|group| Some(*group)).collect();
        let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: None,
            bind_group_layouts: &groups,
            immediate_size: 0,
        });
        Self { module, layout }
    }

    /// A pipeline with these entry points of a vertex and a fragment shader, and these of the latter's constants set.
    #[allow(
        clippy::too_many_arguments,
        reason = "a pipeline is made of so many things, each of its own type"
    )]
    fn pipeline(
        &self,
        device: &wgpu::Device,
        target: Target,
        [vertex, fragment]: [&str; 2],
        constants: &[(&str, f64)],
        buffers: &[Option<wgpu::VertexBufferLayout<'_>>],
        depth: Depth,
        topology: wgpu::PrimitiveTopology,
        blend: Option<wgpu::BlendState>,
    ) -> wgpu::RenderPipeline {
        device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(vertex),
            layout: Some(&self.layout),
            vertex: wgpu::VertexState {
                module: &self.module,
                entry_point: Some(vertex),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                buffers,
            },
            primitive: wgpu::PrimitiveState { topology, ..Default::default() },
            depth_stencil: Some(wgpu::DepthStencilState {
                format: DEPTH,
                depth_write_enabled: Some(depth.write),
                depth_compare: Some(depth.compare),
                stencil: wgpu::StencilState::default(),
                // Depth is reversed: less is farther away.
                bias: if depth.behind {
                    wgpu::DepthBiasState { constant: -8, slope_scale: -1.0, clamp: 0.0 }
                } else {
                    wgpu::DepthBiasState::default()
                },
            }),
            multisample: wgpu::MultisampleState { count: target.samples, ..Default::default() },
            fragment: Some(wgpu::FragmentState {
                module: &self.module,
                entry_point: Some(fragment),
                compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
                targets: &[Some(wgpu::ColorTargetState {
                    format: target.format,
                    blend,
                    write_mask: wgpu::ColorWrites::ALL,
                })],
            }),
            multiview_mask: None,
            cache: None,
        })
    }
}
