//! The viewer in a native window.

use super::{Ask, Viewer};
use crate::render::{self, Offscreen, RenderError, Renderer};
use crate::{headless, picture};
use egui_wgpu::{RendererOptions, ScreenDescriptor};
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};
use winit::application::ApplicationHandler;
use winit::dpi::PhysicalSize;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop};
use winit::window::{Window, WindowId};

/// Between frames while nothing happens: what arrives is drawn within it.
const IDLE: Duration = Duration::from_millis(250);

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
pub enum WindowError {
    /// The system has no screen for us.
    #[error("no window: {0}; on a machine without a screen use `diamantina-client render`")]
    System(String),
    /// Nothing can be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
}

/// Shows a viewer in a window until it is closed.
///
/// # Errors
/// When there is no screen, or no graphics adapter that draws on it.
pub fn run(viewer: Viewer, title: &str, options: &render::Options) -> Result<(), WindowError> {
    let system = |e: &dyn std::fmt::Display| WindowError::System(e.to_string());
    let events = EventLoop::new().map_err(|e| system(&e))?;
    let mut shown = Shown {
        viewer,
        title: title.to_owned(),
        options: *options,
        display: None,
        failed: None,
        due: Instant::now(),
    };
    events.run_app(&mut shown).map_err(|e| system(&e))?;
    shown.failed.map_or(Ok(()), Err)
}

struct Shown {
    viewer: Viewer,
    title: String,
    options: render::Options,
    display: Option<Display>,
    failed: Option<WindowError>,
    /// When the next frame is drawn at the latest.
    due: Instant,
}

/// A window and what draws on it.
struct Display {
    window: Arc<Window>,
    surface: wgpu::Surface<'static>,
    configuration: wgpu::SurfaceConfiguration,
    renderer: Renderer,
    input: egui_winit::State,
    painter: egui_wgpu::Renderer,
}

impl Display {
    fn new(
        events: &ActiveEventLoop,
        title: &str,
        size: [u32; 2],
        options: &render::Options,
    ) -> Result<Self, WindowError> {
        let system = |e: &dyn std::fmt::Display| WindowError::System(e.to_string());
        let attributes =
            Window::default_attributes().with_title(title).with_inner_size(PhysicalSize::<u32>::from(size));
        let window = Arc::new(events.create_window(attributes).map_err(|e| system(&e))?);
        let instance = render::instance();
        let surface = instance.create_surface(window.clone()).map_err(|e| system(&e))?;
        let (adapter, device, queue) = render::device(&instance, Some(&surface), "window")?;
        let found = window.inner_size();
        let mut configuration = surface
            .get_default_config(&adapter, found.width.max(1), found.height.max(1))
            .ok_or_else(|| RenderError::NoAdapter("none that draws on this screen".to_owned()))?;
        // The panel's colours are mixed as they are encoded; the terrain's shader encodes by itself.
        let formats = surface.get_capabilities(&adapter).formats;
        let plain = formats.iter().copied().find(|format| !format.is_srgb());
        configuration.format = plain.unwrap_or(configuration.format);
        surface.configure(&device, &configuration);
        let painter = egui_wgpu::Renderer::new(&device, configuration.format, RendererOptions::default());
        let input = egui_winit::State::new(
            egui::Context::default(),
            egui::ViewportId::ROOT,
            &window,
            None,
            None,
            Some(device.limits().max_texture_dimension_2d as usize),
        );
        let options = render::Options { format: configuration.format, ..*options };
        let renderer = Renderer::new(device, queue, &options);
        Ok(Self { window, surface, configuration, renderer, input, painter })
    }

    fn resize(&mut self, size: PhysicalSize<u32>) {
        // A window may be without any extent for a while.
        if size.width > 0 && size.height > 0 {
            (self.configuration.width, self.configuration.height) = (size.width, size.height);
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

    /// Draws a frame; how long until the next is wanted.
    fn draw(&mut self, viewer: &mut Viewer) -> Duration {
        viewer.resize([self.configuration.width, self.configuration.height]);
        let input = self.input.take_egui_input(&self.window);
        let context = self.input.egui_ctx().clone();
        let mut output = context.run_ui(input, |ui| viewer.update(ui));
        self.input.handle_platform_output(&self.window, output.platform_output);
        let repaint = output.viewport_output.get(&egui::ViewportId::ROOT).map(|view| view.repaint_delay);
        let shapes = context.tessellate(output.shapes, output.pixels_per_point);
        for (id, changes) in output.textures_delta.set.drain() {
            for change in &changes {
                self.painter.update_texture(self.renderer.device(), self.renderer.queue(), id, change);
            }
        }
        if let Some(texture) = self.texture() {
            let view = texture.texture.create_view(&wgpu::TextureViewDescriptor::default());
            let layers = &viewer.terrain().scene().layers;
            let drawn = self.renderer.draw(layers, viewer.camera(), &viewer.items(), viewer.look(), &view);
            self.paint(&view, &shapes, output.pixels_per_point);
            viewer.note(drawn);
            self.window.pre_present_notify();
            self.renderer.queue().present(texture);
        }
        for id in output.textures_delta.free.drain() {
            self.painter.free_texture(&id);
        }
        repaint.unwrap_or(IDLE).min(IDLE)
    }

    /// Draws the panel over the terrain.
    fn paint(&mut self, view: &wgpu::TextureView, shapes: &[egui::ClippedPrimitive], pixels_per_point: f32) {
        let (device, queue) = (self.renderer.device(), self.renderer.queue());
        let size_in_pixels = [self.configuration.width, self.configuration.height];
        let screen = ScreenDescriptor { size_in_pixels, pixels_per_point };
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut commands = self.painter.update_buffers(device, queue, &mut encoder, shapes, &screen);
        let pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("panel"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load: wgpu::LoadOp::Load, store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        self.painter.render(&mut pass.forget_lifetime(), shapes, &screen);
        commands.push(encoder.finish());
        queue.submit(commands);
    }
}

impl Shown {
    fn fulfil(&mut self, events: &ActiveEventLoop) {
        for ask in self.viewer.take_asks() {
            match ask {
                Ask::Quit => events.exit(),
                Ask::Copy(text) => {
                    if let Some(display) = &mut self.display {
                        display.input.set_clipboard_text(text.clone());
                    }
                    self.viewer.tell(format!("copied {text}"));
                }
                Ask::Screenshot(path) => {
                    let saved = self.photograph(&path);
                    self.viewer.tell(match saved {
                        Ok(()) => format!("saved {}", path.display()),
                        Err(error) => error.to_string(),
                    });
                }
            }
        }
    }

    /// Saves a picture of the terrain as it is drawn now, without the panel.
    fn photograph(&self, path: &Path) -> Result<(), headless::HeadlessError> {
        let mut offscreen = Offscreen::new(&self.options)?;
        let layers = &self.viewer.terrain().scene().layers;
        offscreen.draw(layers, self.viewer.camera(), &self.viewer.items(), self.viewer.look())?;
        let picture: picture::Picture = offscreen.read()?;
        headless::save(&picture, path)
    }
}

impl ApplicationHandler for Shown {
    fn resumed(&mut self, events: &ActiveEventLoop) {
        if self.display.is_some() {
            return;
        }
        match Display::new(events, &self.title, self.viewer.camera().size, &self.options) {
            Ok(display) => {
                display.window.request_redraw();
                self.display = Some(display);
            }
            Err(error) => {
                self.failed = Some(error);
                events.exit();
            }
        }
    }

    fn window_event(&mut self, events: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(display) = &mut self.display else { return };
        match &event {
            WindowEvent::CloseRequested => return events.exit(),
            WindowEvent::Resized(size) => display.resize(*size),
            WindowEvent::RedrawRequested => {
                let wait = display.draw(&mut self.viewer);
                self.due = Instant::now() + wait;
                self.fulfil(events);
                return;
            }
            _ => {}
        }
        let response = display.input.on_window_event(&display.window, &event);
        if response.repaint {
            display.window.request_redraw();
        }
    }

    fn about_to_wait(&mut self, events: &ActiveEventLoop) {
        if Instant::now() >= self.due
            && let Some(display) = &self.display
        {
            display.window.request_redraw();
            self.due = Instant::now() + IDLE;
        }
        events.set_control_flow(ControlFlow::WaitUntil(self.due));
    }
}
