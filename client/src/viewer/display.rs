//! A window, or a canvas, and what draws the viewer on it.

use super::Viewer;
use crate::render::{self, Overlay, RenderError, Renderer};
use std::sync::Arc;
use std::time::Duration;
use winit::dpi::PhysicalSize;
use winit::event::{DeviceId, Touch, WindowEvent};
use winit::window::Window;

/// Between frames while nothing happens: what arrives is drawn within it.
pub(crate) const IDLE: Duration = Duration::from_millis(250);

/// A window and what draws on it.
pub(crate) struct Display {
    window: Arc<Window>,
    surface: wgpu::Surface<'static>,
    configuration: wgpu::SurfaceConfiguration,
    renderer: Renderer,
    input: egui_winit::State,
    overlay: Overlay,
    /// Whether imagery in blocks is drawn as fast as any: in software it takes five times as long.
    suits_blocks: bool,
    #[cfg(target_arch = "wasm32")]
    backend: wgpu::Backend,
}

impl Display {
    /// What draws on a window, by one of these kinds of graphics.
    ///
    /// # Errors
    /// When there is no graphics adapter that draws on it.
    pub(crate) async fn new(
        window: Arc<Window>,
        options: &render::Options,
        backends: wgpu::Backends,
    ) -> Result<Self, RenderError> {
        let none = |e: &dyn std::fmt::Display| RenderError::NoAdapter(e.to_string());
        let instance = render::instance(backends).await;
        let surface = instance.create_surface(Arc::clone(&window)).map_err(|e| none(&e))?;
        let (adapter, device, queue) = render::device(&instance, Some(&surface), "window").await?;
        let limit = device.limits().max_texture_dimension_2d;
        let found = window.inner_size();
        let [width, height] = [found.width, found.height].map(|size| size.clamp(1, limit));
        let mut configuration = surface
            .get_default_config(&adapter, width, height)
            .ok_or_else(|| none(&"none that draws on this screen"))?;
        // The panel's colours are mixed as they are encoded; the terrain's shader encodes by itself.
        let formats = surface.get_capabilities(&adapter).formats;
        let plain = formats.iter().copied().find(|format| !format.is_srgb());
        configuration.format = plain.unwrap_or(configuration.format);
        surface.configure(&device, &configuration);
        let overlay = Overlay::new(&device, configuration.format, false);
        let context = egui::Context::default();
        let (view, side) = (egui::ViewportId::ROOT, usize::try_from(limit).ok());
        let input = egui_winit::State::new(context, view, &window, None, None, side);
        let options = render::Options { format: configuration.format, ..render::fit(options, &adapter) };
        let renderer = Renderer::new(device, queue, &options);
        let is_software = adapter.get_info().device_type == wgpu::DeviceType::Cpu;
        let suits_blocks = renderer.reads_blocks() && !is_software;
        Ok(Self {
            window,
            surface,
            configuration,
            renderer,
            input,
            overlay,
            suits_blocks,
            #[cfg(target_arch = "wasm32")]
            backend: adapter.get_info().backend,
        })
    }

    /// What draws.
    #[cfg(target_arch = "wasm32")]
    pub(crate) fn graphics(&self) -> &'static str {
        match self.backend {
            wgpu::Backend::BrowserWebGpu => "webgpu",
            _ => "webgl",
        }
    }

    /// Has `tell` know why the device is lost, should it be.
    #[cfg(target_arch = "wasm32")]
    pub(crate) fn on_loss(&self, tell: fn(&str)) {
        self.renderer.device().set_device_lost_callback(move |_, why| tell(&why));
    }

    /// Asks for a frame.
    pub(crate) fn request_redraw(&self) {
        self.window.request_redraw();
    }

    /// Puts a text on the clipboard.
    #[cfg(not(target_arch = "wasm32"))]
    pub(crate) fn set_clipboard_text(&mut self, text: &str) {
        self.input.set_clipboard_text(text.to_owned());
    }

    /// Takes in an event of the window.
    pub(crate) fn take(&mut self, event: &WindowEvent) {
        // In browsers winit takes each finger for a device of its own, and to egui two fingers are a gesture on one alone.
        let one_device;
        let event = match event {
            WindowEvent::Touch(touch) => {
                one_device = WindowEvent::Touch(Touch { device_id: DeviceId::dummy(), ..*touch });
                &one_device
            }
            other => other,
        };
        if let WindowEvent::Resized(size) = event {
            self.resize(*size);
        }
        if self.input.on_window_event(&self.window, event).repaint {
            self.window.request_redraw();
        }
    }

    fn resize(&mut self, size: PhysicalSize<u32>) {
        // A window may be without any extent for a while.
        if size.width > 0 && size.height > 0 {
            let limit = self.renderer.device().limits().max_texture_dimension_2d;
            let [width, height] = [size.width, size.height].map(|size| size.min(limit));
            (self.configuration.width, self.configuration.height) = (width, height);
            self.surface.configure(self.renderer.device(), &self.configuration);
        }
    }

    /// The texture to draw on; none if the window is hidden, or has changed and is set up anew.
    fn texture(&mut self) -> Option<wgpu::SurfaceTexture> {
        use wgpu::CurrentSurfaceTexture::{Lost, Outdated, Suboptimal, Success};
        match self.surface.get_current_texture() {
            Success(texture) | Suboptimal(texture) => Some(texture),
            Lost | Outdated => {
                self.surface.configure(self.renderer.device(), &self.configuration);
                self.window.request_redraw();
                None
            }
            _ => None,
        }
    }

    /// Tells the viewer what is left of the GPU's memory for the next frame.
    fn count_room(&mut self, viewer: &mut Viewer) {
        // As many pictures as may wait to be shown, and the one that is.
        let images = u64::from(self.configuration.desired_maximum_frame_latency) + 1;
        self.renderer.count_targets(4 * images, self.overlay.bytes());
        let layers = &viewer.terrain().scene().layers;
        let size = [self.configuration.width, self.configuration.height];
        let taken = self.renderer.frame_bytes(layers, size, viewer.look(), viewer.terrain().waters());
        viewer.set_gpu_taken(taken);
    }

    /// Draws a frame, with the panel or, for a picture, without; how long until the next is wanted.
    pub(crate) fn draw(&mut self, viewer: &mut Viewer, with_panel: bool) -> Duration {
        viewer.resize([self.configuration.width, self.configuration.height]);
        viewer.suit_blocks(self.suits_blocks);
        self.count_room(viewer);
        let input = self.input.take_egui_input(&self.window);
        let context = self.input.egui_ctx().clone();
        let mut output = context.run_ui(input, |ui| viewer.frame_of(ui, with_panel));
        self.input.handle_platform_output(&self.window, std::mem::take(&mut output.platform_output));
        let repaint = output.viewport_output.get(&egui::ViewportId::ROOT).map(|view| view.repaint_delay);
        let shapes = self.overlay.take(self.renderer.device(), self.renderer.queue(), &context, output);
        if let Some(texture) = self.texture() {
            let view = texture.texture.create_view(&wgpu::TextureViewDescriptor::default());
            let layers = &viewer.terrain().scene().layers;
            self.renderer.drape(viewer.drape());
            self.renderer.mirror(viewer.mirrors());
            let drawn = self.renderer.draw(layers, viewer.camera(), &viewer.items(), viewer.look(), &view);
            let size = [self.configuration.width, self.configuration.height];
            self.overlay.paint(self.renderer.device(), self.renderer.queue(), &view, size, &shapes);
            viewer.note(drawn);
            self.window.pre_present_notify();
            self.renderer.queue().present(texture);
        }
        self.overlay.end(shapes);
        repaint.unwrap_or(IDLE).min(IDLE)
    }
}
