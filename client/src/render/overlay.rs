//! What egui draws over a picture: the viewer's panel, and annotations.

use egui::{Context, FullOutput, TextureId};
use egui_wgpu::{RendererOptions, ScreenDescriptor};
use std::collections::HashMap;

/// Draws what an egui context has to show. Its colours are mixed as they are encoded, so its targets are views of a format
/// that stores them as they are.
pub(crate) struct Overlay {
    painter: egui_wgpu::Renderer,
    /// Bytes that each of its textures takes.
    textures: HashMap<TextureId, u64>,
}

/// What to draw, and when.
#[must_use]
pub(crate) struct Shapes {
    triangles: Vec<egui::ClippedPrimitive>,
    pixels_per_point: f32,
    /// Textures that are not needed after it.
    free: Vec<TextureId>,
}

impl Overlay {
    /// What draws to views of a format. `exact`: without dithering, so that a colour is that of each of its pixels.
    pub(crate) fn new(device: &wgpu::Device, format: wgpu::TextureFormat, exact: bool) -> Self {
        let options = if exact { RendererOptions::PREDICTABLE } else { RendererOptions::default() };
        Self { painter: egui_wgpu::Renderer::new(device, format, options), textures: HashMap::new() }
    }

    /// Bytes of GPU memory that letters and other textures take.
    pub(crate) fn bytes(&self) -> u64 {
        self.textures.values().sum()
    }

    /// Takes in what a frame of the context gave: each frame, drawn or not, or textures are lost.
    pub(crate) fn take(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        context: &Context,
        mut output: FullOutput,
    ) -> Shapes {
        let pixels_per_point = output.pixels_per_point;
        let triangles = context.tessellate(std::mem::take(&mut output.shapes), pixels_per_point);
        for (id, changes) in output.textures_delta.set.drain() {
            for change in &changes {
                if change.pos.is_none() {
                    let [width, height] = change.image.size();
                    self.textures.insert(id, 4 * (width * height) as u64);
                }
                self.painter.update_texture(device, queue, id, change);
            }
        }
        let free = output.textures_delta.free.drain().collect();
        Shapes { triangles, pixels_per_point, free }
    }

    /// Draws over what a view of so many pixels holds, and sends it to the GPU.
    pub(crate) fn paint(
        &mut self,
        device: &wgpu::Device,
        queue: &wgpu::Queue,
        view: &wgpu::TextureView,
        size_in_pixels: [u32; 2],
        shapes: &Shapes,
    ) {
        let screen = ScreenDescriptor { size_in_pixels, pixels_per_point: shapes.pixels_per_point };
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut commands =
            self.painter.update_buffers(device, queue, &mut encoder, &shapes.triangles, &screen);
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("overlay"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        self.painter.render(&mut pass.forget_lifetime(), &shapes.triangles, &screen);
        commands.push(encoder.finish());
        queue.submit(commands);
    }

    /// Frees what was needed for these shapes alone.
    pub(crate) fn end(&mut self, shapes: Shapes) {
        for id in shapes.free {
            self.textures.remove(&id);
            self.painter.free_texture(&id);
        }
    }
}
