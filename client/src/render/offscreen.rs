//! Pictures without a window.

use super::{BACKENDS, FrameStats, Look, Options, Overlay, RenderError, Renderer, device, fit, instance};
use crate::camera::Camera;
use crate::drawing::{DrawItem, Mirror};
use crate::picture::Picture;
use crate::texture::Drape;
use diamantina_protocol::message::Layer;
use egui::{Context, Painter, Pos2, RawInput, Rect, Vec2, ViewportId};

/// The target's format where what is drawn over the picture mixes colours: the same bytes, as they are.
const PLAIN: wgpu::TextureFormat = wgpu::TextureFormat::Rgba8Unorm;

/// Bytes a pixel that a picture takes: its target, and what it comes back by, but for the ends of its rows.
const TARGET_BYTES: u64 = 8;

/// A renderer with a target of its own, as large as the last picture.
pub struct Offscreen {
    renderer: Renderer,
    target: Option<wgpu::Texture>,
    /// Made when something is first drawn over a picture.
    overlay: Option<(Context, Overlay)>,
}

impl Offscreen {
    /// A renderer on the best adapter that there is, in software if need be. `options.format` is
    /// replaced by the format of a [`Picture`]. Costs some tens of milliseconds.
    ///
    /// # Errors
    /// When there is no adapter, or it gives no device.
    pub fn new(options: &Options) -> Result<Self, RenderError> {
        let found = async { device(&instance(BACKENDS).await, None, "offscreen").await };
        let (adapter, device, queue) = pollster::block_on(found)?;
        let options = Options { format: wgpu::TextureFormat::Rgba8UnormSrgb, ..fit(options, &adapter) };
        let mut renderer = Renderer::new(device, queue, &options);
        renderer.count_targets(TARGET_BYTES, 0);
        Ok(Self { renderer, target: None, overlay: None })
    }

    /// See [`Renderer::drape`].
    pub fn drape(&mut self, drape: Option<&Drape>) {
        self.renderer.drape(drape);
    }

    /// See [`Renderer::mirror`].
    pub fn mirror(&mut self, mirrors: &[Mirror]) {
        self.renderer.mirror(mirrors);
    }

    /// See [`Renderer::reads_blocks`].
    #[must_use]
    pub fn reads_blocks(&self) -> bool {
        self.renderer.reads_blocks()
    }

    #[cfg(test)]
    pub(super) fn device(&self) -> &wgpu::Device {
        self.renderer.device()
    }

    /// See [`Renderer::frame_bytes`].
    #[must_use]
    pub fn frame_bytes(&self, layers: &[Layer], size: [u32; 2], look: &Look, waters: usize) -> u64 {
        self.renderer.frame_bytes(layers, size, look, waters)
    }

    /// Draws a frame of `camera.size` pixels. See [`Renderer::draw`].
    ///
    /// # Errors
    /// When the picture is empty or larger than the adapter can draw.
    pub fn draw(
        &mut self,
        layers: &[Layer],
        camera: &Camera,
        items: &[DrawItem],
        look: &Look,
    ) -> Result<FrameStats, RenderError> {
        let [width, height] = camera.size;
        let limit = self.renderer.device().limits().max_texture_dimension_2d;
        if !(1..=limit).contains(&width) || !(1..=limit).contains(&height) {
            return Err(RenderError::Size { found: camera.size, limit });
        }
        let target = match self.target.take() {
            Some(target) if [target.width(), target.height()] == camera.size => target,
            _ => self.renderer.device().create_texture(&wgpu::TextureDescriptor {
                label: Some("picture"),
                size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
                mip_level_count: 1,
                sample_count: 1,
                dimension: wgpu::TextureDimension::D2,
                format: wgpu::TextureFormat::Rgba8UnormSrgb,
                usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
                view_formats: &[PLAIN],
            }),
        };
        let view = target.create_view(&wgpu::TextureViewDescriptor::default());
        self.target = Some(target);
        Ok(self.renderer.draw(layers, camera, items, look, &view))
    }

    /// Draws over the picture last drawn, if there is one, with egui. `pixels_per_point`: how large its points are. `draw`
    /// gets the picture's extent in points.
    pub fn draw_over(&mut self, pixels_per_point: f32, mut draw: impl FnMut(&Painter, Rect)) {
        let Some(target) = &self.target else { return };
        let (device, queue) = (self.renderer.device(), self.renderer.queue());
        let (context, overlay) =
            self.overlay.get_or_insert_with(|| (Context::default(), Overlay::new(device, PLAIN, true)));
        let size = [target.width(), target.height()];
        let [width, height] = size.map(|pixels| pixels as f32 / pixels_per_point);
        let mut input = RawInput {
            screen_rect: Some(Rect::from_min_size(Pos2::ZERO, Vec2::new(width, height))),
            max_texture_side: usize::try_from(device.limits().max_texture_dimension_2d).ok(),
            ..RawInput::default()
        };
        let viewport = input.viewports.entry(ViewportId::ROOT).or_default();
        viewport.native_pixels_per_point = Some(pixels_per_point);
        let output = context.run_ui(input, |ui| draw(ui.painter(), ui.max_rect()));
        let shapes = overlay.take(device, queue, context, output);
        let view =
            target.create_view(&wgpu::TextureViewDescriptor { format: Some(PLAIN), ..Default::default() });
        overlay.paint(device, queue, &view, size, &shapes);
        overlay.end(shapes);
    }

    /// Waits until the GPU is done with all that was drawn.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn wait(&self) -> Result<(), RenderError> {
        let done = self.renderer.device().poll(wgpu::PollType::wait_indefinitely());
        done.map(|_| ()).map_err(|e| RenderError::Read(e.to_string()))
    }

    /// The picture last drawn, once the GPU is done with it; an empty one before the first.
    ///
    /// # Errors
    /// When the device was lost.
    pub fn read(&self) -> Result<Picture, RenderError> {
        let Some(target) = &self.target else { return Ok(Picture { size: [0, 0], pixels: Vec::new() }) };
        let (device, queue) = (self.renderer.device(), self.renderer.queue());
        let [width, height] = [target.width(), target.height()];
        let row_bytes = (4 * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let buffer = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("picture"),
            size: u64::from(row_bytes) * u64::from(height),
            usage: wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ,
            mapped_at_creation: false,
        });
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_texture_to_buffer(
            target.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &buffer,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: 0,
                    bytes_per_row: Some(row_bytes),
                    rows_per_image: None,
                },
            },
            target.size(),
        );
        queue.submit([encoder.finish()]);
        let (sender, receiver) = std::sync::mpsc::channel();
        buffer.map_async(wgpu::MapMode::Read, .., move |result| {
            // The receiver waits below.
            let _ = sender.send(result);
        });
        let lost = |e: &dyn std::fmt::Display| RenderError::Read(e.to_string());
        device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| lost(&e))?;
        receiver.recv().map_err(|e| lost(&e))?.map_err(|e| lost(&e))?;
        let bytes = buffer.get_mapped_range(..).map_err(|e| lost(&e))?;
        let mut pixels = Vec::with_capacity(4 * width as usize * height as usize);
        for row in bytes.chunks_exact(row_bytes as usize) {
            pixels.extend_from_slice(&row[..4 * width as usize]);
        }
        Ok(Picture { size: [width, height], pixels })
    }
}
